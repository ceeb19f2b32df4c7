"""The public result: `Reconstruction`, its assembly from the polish, its summary and notes, reading it back.

Takes a polished solution and the frames of the source, gives a `Reconstruction`. May import `polish` and the rooms
below it. One exception: `Reconstruction.write` calls up to `report`.
"""
