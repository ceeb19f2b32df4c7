"""What is known beforehand of poses, points, distances and heights: files, world alignment, residuals, the solve.

Takes control and a free solution, gives the solution under control. May import `lens` and what lies below it.
"""
