"""What is done with results that are there: packing, merging, publishing and verifying them."""
