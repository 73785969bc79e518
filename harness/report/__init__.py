"""Pictures, plots and tables, computed from result rows and recordings only; this package simulates nothing."""
