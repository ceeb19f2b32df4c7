"""What faults do to a stream: ``python -m benchmarks.faults [--runs 200]``.

Every run follows a shot whose frames or depth maps are disturbed at random, in a process of its own, which may also be
killed and resumed. It must end in time with a result or a clear reason, and must not give a wrong pose with a small
covariance.
"""
