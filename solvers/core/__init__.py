"""What methods share: the objective, descent and line search, saddle points, spring forms, vertex terms."""
