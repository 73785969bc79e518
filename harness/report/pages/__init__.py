"""Pages that show published results: templates, the queries that fill them, and their pictures."""
