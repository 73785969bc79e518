"""Error control: methods that meet a requested error, the choice among them, and its verification."""
