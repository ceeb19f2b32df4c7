"""The paper's evaluation from one command: ``python -m benchmarks.run --data FOLDER``."""
