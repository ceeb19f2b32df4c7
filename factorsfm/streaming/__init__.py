"""Frames one by one: the stream, films of several shots, live sources, snapshots, lost views found again.

Takes frames, gives a pose for each at once and a reconstruction at the end. May import `imagesets` and what lies below
it.
"""
