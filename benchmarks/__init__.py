"""The benchmarks: the paper's evaluation (``python -m benchmarks.run --data FOLDER``), and others beside it.

`plan` says what is measured on what; `run` measures it, each cell in a process of its own (`cell`) whose record is kept
(`store`); `tables`, `comparison` and `figures` draw the results. The other modules are commands of their own.
"""
