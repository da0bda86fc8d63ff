"""Exit codes of ``ember``, in addition to 0 for success and 2 for an error."""

DIFFERENT = 1
"""A replay that differs from its record, or a bag with damage."""
INTERRUPTED = 130
"""Stopped by Ctrl-C; the code that shells use."""
