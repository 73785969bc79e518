"""All code that is written for vector registers, beyond what a compiler finds by itself."""
