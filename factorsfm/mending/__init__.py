"""Mending a finished result: tracks, regions and frames left out, control and tracks added, and solved again.

Takes what a result keeps of its measurements, gives another result. May import `report` and what lies below it.
"""
