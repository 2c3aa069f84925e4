"""The run in the rerun viewer."""
