"""What the parts cost, on rendered and synthetic input: ``python -m benchmarks.micro [--models FOLDER]``."""
