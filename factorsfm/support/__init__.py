"""What every room may import: errors, options, statuses, threads, rotations, similarities. Imports no other room."""
