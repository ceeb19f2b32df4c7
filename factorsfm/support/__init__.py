"""What every room may import: errors, options, statuses, JSON, threads, and small pieces of geometry.

Imports no other room.
"""
