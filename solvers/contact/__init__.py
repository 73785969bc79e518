"""Contact: its energy, and what the prefactored methods make of it."""
