"""Charts as plain data: one builder for each kind, which figures, sheets and the results page draw."""
