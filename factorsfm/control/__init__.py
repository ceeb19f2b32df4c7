"""Known poses, points, distances and heights: files, world alignment, residuals, the solve under control.

Takes control and a free solution, gives the solution under control. May import `lens` and what lies below it.
"""
