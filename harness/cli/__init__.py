"""Command line: one module for each command, with imports deferred until the command runs."""
