"""A stream in Rerun, live or recorded.

Takes frames and updates, gives a recording. May import `streaming` and the rooms below it.
"""
