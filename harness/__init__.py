"""The benchmark harness: scenes, sweeps, measurements, recordings, pictures and the command line."""
