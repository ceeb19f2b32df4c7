"""Photographs in any order: working copies, pairing, start, order of registration, and further images for a result.

Takes images, gives a reconstruction. May import `report` and what lies below it.
"""
