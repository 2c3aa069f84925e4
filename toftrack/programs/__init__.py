"""The command-line programs: thin, each one `main` under one style of argument parser."""
