"""What every room may use: errors, options, statuses, threads, rotations and similarities. Imports no other room."""
