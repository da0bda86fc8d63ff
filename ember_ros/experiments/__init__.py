"""Experiments: one command each, seeds and all; results as JSON and CSV, a figure and a page."""
