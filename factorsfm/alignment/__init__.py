"""A result that stands on its ground: up, ground, origin and unit without a survey.

Takes a `Reconstruction` and, for vertical edges, the frames of its footage; gives it in a world that is level. May
import `export` and the rooms below it.
"""
