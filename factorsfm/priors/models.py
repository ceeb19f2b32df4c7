"""Named networks: their source, their checksum and the folder that holds them.

A named network is looked up in the folder that the environment variable ``FACTORSFM_MODELS`` names, then in the user's
cache; if it is in neither, it is fetched where a source is known. Its checksum is verified every time.
"""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pooch

from factorsfm.support.errors import ModelError

logger = logging.getLogger(__name__)

MODELS_VARIABLE = "FACTORSFM_MODELS"
_TIMEOUT_SECONDS = (3.0, 15.0)  # connect, read


@dataclass(frozen=True, slots=True)
class NamedModel:
    """A network that users can name.

    Attributes:
        gives: the option that takes its output, without the dashes.
        file: file name, the same in all folders and at its source.
        url: where it is fetched from, pinned to one revision; None where no source offers this file.
        sha256: hexadecimal digest of the file.
        license: licence of the weights.
        origin: what the file was made from, where there is no `url`.
    """

    gives: Literal["depth", "masks"]
    file: str
    url: str | None
    sha256: str
    license: str
    origin: str = ""


MODELS: dict[str, NamedModel] = {
    "tcmonodepth": NamedModel(
        gives="depth",
        file="tcmonodepth_tcsmallnet_192x320.onnx",
        url="https://raw.githubusercontent.com/royshil/obs-backgroundremoval/875ffda/data/models/"
        "tcmonodepth_tcsmallnet_192x320.onnx",
        sha256="902b886beaebd3f68deb40bab2fd636a0c112c1ef1cbdd15fa26e5c55b389b4d",
        license="MIT",
    ),
    "deeplab": NamedModel(
        gives="masks",
        file="deeplabv3_mnv2_dm05_pascal.onnx",
        url=None,
        sha256="e80797f7dd3219da414cb0db8898c21079af9340f737c4c008e5cfbe8192a5a1",
        license="Apache-2.0",
        origin="deeplabv3_mnv2_dm05_pascal_quant.tflite of google-coral/test_data at 104342d",
    ),
}


def cache_folder() -> Path:
    """The user's cache folder for networks; it may not exist yet."""
    return Path(pooch.os_cache("factorsfm")) / "models"


def model_folders() -> list[Path]:
    """The folders in which networks are looked up: that of ``FACTORSFM_MODELS``, if set, and the user's cache.

    Raises:
        ModelError: the variable does not name a folder.
    """
    variable = os.environ.get(MODELS_VARIABLE)
    if not variable:
        return [cache_folder()]
    if not Path(variable).is_dir():
        raise ModelError(f"{MODELS_VARIABLE} must name a folder of networks, not {variable}")
    return [Path(variable), cache_folder()]


def find_model(path_or_name: str | Path) -> Path:
    """The file of a network given by its path or its name (a key of `MODELS`).

    Raises:
        ModelError: there is no such file or name, the checksum does not match, or a named network is not on this
            machine and cannot be fetched.
    """
    if str(path_or_name) in MODELS:
        return _find_named(str(path_or_name))
    path = Path(path_or_name)
    if not path.is_file():
        raise ModelError(f"there is no network {path}; expected an ONNX file or one of: {', '.join(MODELS)}")
    return path


def named_model(path: Path) -> str | None:
    """The name of the network with this file's checksum, None if there is none."""
    digest = pooch.file_hash(str(path), alg="sha256") if path.is_file() else ""
    return next((name for name, model in MODELS.items() if model.sha256 == digest), None)


def _find_named(name: str) -> Path:
    for folder in model_folders():
        path = folder / MODELS[name].file
        if path.is_file():
            return _verified(path, name)
    return _fetch(name)


def _verified(path: Path, name: str) -> Path:
    digest = pooch.file_hash(str(path), alg="sha256")
    expected = MODELS[name].sha256
    if digest != expected:
        raise ModelError(
            f"{path} is not the network {name}: its SHA-256 starts with {digest[:12]}, expected "
            f"{expected[:12]}; delete the file to have it fetched again"
        )
    return path


def _fetch(name: str) -> Path:
    model = MODELS[name]
    folder = cache_folder()
    if model.url is None:
        raise ModelError(
            f"the network {name} is not on this machine and cannot be fetched: put {model.file} (SHA-256 "
            f"{model.sha256[:12]}...) into the folder that {MODELS_VARIABLE} names or into {folder}, or convert "
            f"{model.origin} to ONNX and pass --{model.gives} FILE.onnx"
        )
    logger.info("fetching the network %s from %s to %s", name, model.url, folder)
    pooch.get_logger().setLevel(logging.WARNING)  # it would write progress to stderr
    try:
        pooch.retrieve(
            model.url,
            known_hash=f"sha256:{model.sha256}",
            fname=model.file,
            path=folder,
            downloader=pooch.HTTPDownloader(timeout=_TIMEOUT_SECONDS),
        )
    except (OSError, ValueError) as error:  # no connection, an HTTP error, a wrong checksum, a read-only cache
        raise ModelError(
            f"the network {name} is not on this machine and could not be fetched ({type(error).__name__}): "
            f"set {MODELS_VARIABLE} to a folder that holds {model.file}, or pass --{model.gives} FILE or "
            f"--{model.gives} none"
        ) from error
    return folder / model.file
