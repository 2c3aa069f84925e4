"""The one place that measures: how accurate, how fast, and what each part brings."""
