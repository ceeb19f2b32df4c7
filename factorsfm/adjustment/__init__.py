"""The batch solver: residuals, variables and their columns, elimination, marginals, models of the errors.

Takes observations and a state, gives the state of least cost and its covariances. May import `tracks` and what
lies below it.
"""
