"""Worker processes, locks, progress and interrupts."""
