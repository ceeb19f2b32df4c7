"""Rigid things that move by themselves: their tracks solved as a scene of its own, before cameras that are known.

Takes masks of the things, or finds them among the tracks that the scene does not explain, and the cameras of the scene;
gives poses, points and scale of each. May import `polish` and what lies below it.
"""
