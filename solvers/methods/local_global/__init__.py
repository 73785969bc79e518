"""Local-global iterations over one prefactored matrix, and their variants."""
