"""The command line: one module per command.

Takes arguments, gives files and sentences. It calls the Python interface and holds no algorithm. May import every room.
"""
