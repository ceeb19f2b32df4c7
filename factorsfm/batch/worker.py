"""The work of a batch: find the shots of a video; reconstruct a shot and write its result folder."""

from __future__ import annotations

import time
from contextlib import nullcontext

from factorsfm import api
from factorsfm.alignment.align import align
from factorsfm.batch.plan import Job, Video, shots_of
from factorsfm.report.result_folder import write_failure, write_folder
from factorsfm.support.errors import FactorsfmError, ReconstructionError
from factorsfm.support.progress import Progress
from factorsfm.support.threads import OneThreadEach


def find_shots_of(video: Video, *, one_thread: bool) -> list[range]:
    """Shots of a video; errors as in `plan.shots_of`."""
    with OneThreadEach() if one_thread else nullcontext():
        return shots_of(video)


def reconstruct_shot(job: Job, *, one_thread: bool, progress: Progress | None = None) -> None:
    """Reconstruct a shot and write its result folder, also if it fails.

    Args:
        one_thread: use one thread, because each worker has only one core.

    Raises:
        InputError: the folder cannot be written.
    """
    begin = time.perf_counter()
    method = job.method
    try:
        # A network that is opened inside uses one thread, too, see `priors.networks`.
        with OneThreadEach() if one_thread else nullcontext():
            reconstruction = api.reconstruct(
                job.video.path,
                camera=method.camera,
                depth=method.depth,
                depth_kind=method.depth_kind,
                masks=method.masks,
                objects=method.objects,
                frames=slice(job.frames.start, job.frames.stop),
                preset=method.preset,
                lens=method.lens,
                shutter=method.shutter,
                fields=job.video.fields,
                pixel_aspect=method.pixel_aspect,
                progress=progress,
            )
            if method.align:
                reconstruction = align(reconstruction)
    except FactorsfmError as error:
        frames = error.frames if isinstance(error, ReconstructionError) else ()
        options = {"source": str(job.video.path), "job": job.to_dict()}
        write_failure(job.folder, str(error), frames, options, {"total": time.perf_counter() - begin})
        return
    reconstruction.options["job"] = job.to_dict()
    write_folder(reconstruction, job.folder)
