"""The command line: one module a command.

Takes arguments, gives files and sentences; it reads arguments and calls the Python interface. No algorithm. May import
every room below: it is the top.
"""
