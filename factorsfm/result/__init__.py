"""The public result: `Reconstruction`, its assembly from the polish, its summary and notes, reading it back.

Takes a solved problem with what is known of the frames, gives a `Reconstruction`. May import `polish` and what lies
below it; `Reconstruction.write` alone calls up, to `report`.
"""
