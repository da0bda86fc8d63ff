"""What came of a run: its record while it runs, its figures and its summary afterwards."""
