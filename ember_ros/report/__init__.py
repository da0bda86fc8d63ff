"""Statistics, figures and summaries of a run."""
