"""The experiments, one per file: each defines its arms, curves, claims, text and figure."""
