"""Exit codes besides 0, and 2 for a mistake."""

DIFFERENT = 1
"""Of a replay that came out otherwise, or of a bag with damage in it."""
INTERRUPTED = 130
"""Of an end by Ctrl-C, as the shell has it."""
