"""One experiment a file: its arms, its curves, its text and its figure."""
