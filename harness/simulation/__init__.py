"""One run: steps through time, their measurement, and what is looked at in them."""
