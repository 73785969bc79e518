"""Charts as plain data, which figures, sheets and the results page draw."""
