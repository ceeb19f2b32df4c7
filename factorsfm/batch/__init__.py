"""Films: the plan of shots, the workers, the index page over all results.

Takes videos, gives a result folder for every shot. May import `api` and the rooms below it.
"""
