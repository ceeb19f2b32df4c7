"""Lenses: camera files, EXIF and the first guess, projection.

Takes files and image sizes, gives a `pycolmap.Camera`. May import `support`.
"""
