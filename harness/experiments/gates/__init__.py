"""Gates: is this slower than that, and by how much? Two programs take turns until an interval answers."""
