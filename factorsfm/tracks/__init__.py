"""Correspondences: optical flow for video, feature matches for image sets.

Takes images, gives tracks. May import `priors` and what lies below it. Its face: `flow.FlowTracker` for video,
`matches.match_images` and `match_tracks.tracks_from_matches` for image sets, `image_tracks.ImageTracks`.
"""
