"""Extended position-based dynamics."""
