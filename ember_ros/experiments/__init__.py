"""Experiments: one command each, seeds and all; results as JSON and as a page of figures."""
