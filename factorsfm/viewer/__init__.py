"""What a stream does, live or recorded, in Rerun.

Takes frames and updates, gives a recording. May import `streaming` and what lies below it.
"""
