"""What a worker does with a job: the same as ``factorsfm reconstruct``, and the result or the failure on disk."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

from factorsfm import api
from factorsfm.batch.plan import Job, Video, shots_of
from factorsfm.errors import FactorsfmError, ReconstructionError
from factorsfm.export.folder import write_failure, write_folder
from factorsfm.threads import OneThreadEach, available_cores

Progress = Callable[[str, int, int | None], None]


def find_shots_of(video: Video, *, one_thread: bool) -> list[range]:
    """Shots of a video; errors as in `plan.shots_of`, `one_thread` as in `reconstruct_shot`."""
    with _threads(one_thread):
        return shots_of(video)


def reconstruct_shot(job: Job, *, one_thread: bool, progress: Progress | None = None) -> None:
    """Write the result of a shot, or why there is none.

    Args:
        one_thread: keep to one thread wherever there are more cores, too: others may use them.

    Raises:
        InputError: the folder cannot be written.
    """
    begin = time.perf_counter()
    method = job.method
    try:
        # A network opened inside keeps to one thread, too, see `priors.networks`.
        with _threads(one_thread):
            reconstruction = api.reconstruct(
                job.video.path,
                camera=method.camera,
                depth=method.depth,
                depth_kind=method.depth_kind,
                masks=method.masks,
                frames=slice(job.frames.start, job.frames.stop),
                preset=method.preset,
                lens=method.lens,
                progress=progress,
            )
    except FactorsfmError as error:
        frames = error.frames if isinstance(error, ReconstructionError) else ()
        options = {"source": str(job.video.path), "job": job.to_dict()}
        write_failure(job.folder, str(error), frames, options, {"total": time.perf_counter() - begin})
        return
    reconstruction.options["job"] = job.to_dict()
    write_folder(reconstruction, job.folder)


def _threads(one: bool) -> AbstractContextManager[object]:
    """On a single core, several threads of a library would only wait for each other."""
    return OneThreadEach() if one or len(available_cores()) == 1 else nullcontext()
