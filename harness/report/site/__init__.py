"""The page of all results, opened from the file system, and the viewer that replays recordings in it."""
