"""The batch solver: variables and their columns, residuals, elimination of the points, covariances, error models.

Takes observations and a state, gives the state of least cost and its covariances. May import `tracks` and what
lies below it.
"""
