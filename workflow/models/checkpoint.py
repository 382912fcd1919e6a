"""Checks checkpoints on disk while Snakemake plans: packages, folder, revision, classes, channels, licence.

Nothing is downloaded, because users have to read and accept the licences of these models themselves.
"""

from __future__ import annotations

import importlib.metadata
import json
import math
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from iif_core.errors import InputError
from workflow.intake.documents import check_file

PACKAGES = ("diffusers", "transformers", "safetensors", "torch")
COMPONENTS = {
    "tokenizer": "CLIPTokenizer",
    "text_encoder": "CLIPTextModel",
    "unet": "UNet2DConditionModel",
    "vae": "AutoencoderKL",
    "scheduler": "DDIMScheduler",
}
LATENT = 4
"""Channels of the latent space of Stable Diffusion 1 and 2, from which both models derive."""
_STEM = {"text_encoder": "model", "unet": "diffusion_pytorch_model", "vae": "diffusion_pytorch_model"}
_REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")


@dataclass(frozen=True, kw_only=True)
class Origin:
    """Where a model comes from.

    Attributes:
        repository: where its authors publish it.
        licence: as text.
        section: of the settings that names the checkpoint.
        index: file that describes the content of its folder.
        layout: description of the folder.
        page: of the documentation.
    """

    repository: str
    licence: str
    section: str = "prior"
    index: str = "model_index.json"
    layout: str = "diffusers' layout"
    page: str = "docs/guide/priors.md"


@dataclass(frozen=True, kw_only=True)
class Recipe(Origin):
    """What the checkpoint of a prior must be, and how it is used.

    Attributes:
        kind: of the prior.
        pipeline: class in model_index.json.
        targets: number of latent images that the U-Net predicts at once, given model_index.json (raises InputError).
        prompts: one pass of the U-Net each.
        fill_prompts: whether prompts are padded to the length with which the text encoder was trained.
        condition_first: whether the U-Net reads the photograph's channels before the noisy ones.
        scheduler: replacements of the checkpoint's own settings of the scheduler.
    """

    kind: str
    pipeline: str
    targets: Callable[[dict[str, Any]], int]
    prompts: tuple[str, ...]
    fill_prompts: bool
    condition_first: bool
    scheduler: tuple[tuple[str, Any], ...] = ()


@dataclass(frozen=True)
class Checkpoint:
    """A checked checkpoint.

    Attributes:
        folder: of its files.
        revision: 40 hexadecimal digits, or None if unknown.
        index: the document that describes it.
        weights: file of each component.
        files: all files that are read.
    """

    folder: Path
    revision: str | None
    index: dict[str, Any]
    weights: dict[str, Path]
    files: tuple[Path, ...]

    def variant(self, component: str) -> str | None:
        """Return the published precision of the weights of a component; None = float32."""
        return "fp16" if self.weights[component].name.endswith(".fp16.safetensors") else None


def check(prior: dict[str, Any], recipe: Recipe) -> Checkpoint:
    """Find and check the checkpoint that the settings section `prior`, as plain values, names.

    Raises:
        InputError: a package, the folder or one of its files is missing; another model or revision; licence not accepted.
    """
    require_packages(f"`prior: {{kind: {recipe.kind}}}`", PACKAGES)
    require_device(prior["device"], recipe)
    folder, revision = find_checkpoint(prior["checkpoint"], prior["revision"], recipe)
    index = read_json(folder / "model_index.json", recipe)
    _check_classes(folder, index, recipe)
    weights = {component: weights_in(folder / component, stem) for component, stem in _STEM.items()}
    headers = {component: tensor_header(path) for component, path in weights.items()}
    try:
        targets = recipe.targets(index)
    except InputError as error:
        raise InputError(f"{folder / 'model_index.json'}: {error}") from None
    _check_channels(folder, targets, headers["unet"], recipe)
    require_accepted(prior["accept_license"], folder, recipe)
    files = [folder / "model_index.json", *weights.values()]
    for component in COMPONENTS:
        files += [path for path in (folder / component).iterdir() if path.suffix in (".json", ".txt")]
    return Checkpoint(folder, revision, index, weights, tuple(sorted(files)))


def require_packages(setting: str, names: tuple[str, ...]) -> None:
    """Refuse settings whose job would fail with an ImportError."""
    missing = [name for name in names if find_spec(name) is None]
    if missing:
        raise InputError(f"{setting} needs {', '.join(missing)}, which this Python lacks; run `bash envs/setup.sh`")


def require_accepted(accepted: bool, folder: Path, origin: Origin) -> None:
    """Refuse weights whose licence the user has not accepted."""
    if not accepted:
        raise InputError(
            f"`{origin.section}.accept_license`: found false. {origin.repository} comes under {origin.licence}; {_terms(folder)}"
            f" and, if you may use it, set {setting_as_yaml(origin.section, 'accept_license: true')}"
        )


def setting_as_yaml(section: str, setting: str) -> str:
    """Return a setting as YAML in backquotes; sections may be nested.

    >>> setting_as_yaml("segmentation.sam2", "device: auto")
    '`segmentation: {sam2: {device: auto}}`'
    """
    text = setting
    for name in reversed(section.split(".")):
        text = f"{name}: {{{text}}}"
    return f"`{text}`"


def require_device(device: str, origin: Origin) -> None:
    """Refuse `cuda` where torch was built without it."""
    torch = importlib.metadata.version("torch")
    if device == "cuda" and "+cpu" in torch:
        raise InputError(
            f"`{origin.section}.device`: found cuda, but torch is the CPU build {torch}; envs/README.md says how to install a"
            f" CUDA build, or set {setting_as_yaml(origin.section, 'device: auto')}"
        )


# ----------------------------------------------------------------------------------------------------------------- where


def find_checkpoint(checkpoint: str, revision: str | None, origin: Origin) -> tuple[Path, str | None]:
    """Find a checkpoint, given by its path or by the name of a repository in the local cache.

    Returns its folder and its revision, if known.

    Raises:
        InputError: not found, or another revision.
    """
    folder = Path(checkpoint).expanduser()
    if folder.is_dir():
        found = _revision_of(folder, origin.index)
        if revision and found and not found.startswith(revision):
            raise InputError(
                f"{folder}: revision {found}, needed {revision} (`{origin.section}.revision`); download that one, or set"
                f" {setting_as_yaml(origin.section, f'revision: {found}')} if this one is meant"
            )
        return folder, found
    if _REPOSITORY.fullmatch(checkpoint) is None:
        raise InputError(f"{folder}: not found; `{origin.section}.checkpoint` is a folder in {origin.layout}. {_get_it(origin)}")
    return _in_cache(checkpoint, revision, origin)


def _in_cache(repository: str, revision: str | None, origin: Origin) -> tuple[Path, str]:
    """Return the snapshot of a repository in the local cache of huggingface_hub, as `hf download` writes it, and its revision."""
    from huggingface_hub.constants import HF_HUB_CACHE

    snapshots = Path(HF_HUB_CACHE) / f"models--{repository.replace('/', '--')}" / "snapshots"
    present = sorted(path.name for path in snapshots.iterdir()) if snapshots.is_dir() else []
    if revision is None and present:
        raise InputError(
            f"`{origin.section}.revision`: missing; of {repository} the cache holds {', '.join(present)}. Name the one to use"
        )
    found = [name for name in present if name.startswith(revision or "")]
    if len(found) != 1:
        holds = f"the cache {snapshots.parents[1]} holds {', '.join(present) if present else 'nothing of it'}"
        wanted = f" at revision {revision}" if revision else ""
        raise InputError(
            f"`{origin.section}.checkpoint`: {repository}{wanted} is not here ({holds}). {_get_it(origin, repository, revision)}"
        )
    return snapshots / found[0], found[0]


def _revision_of(folder: Path, index: str) -> str | None:
    """Return the revision that `hf download --local-dir` noted in a folder, or the name of a snapshot in the cache."""
    note = folder / f".cache/huggingface/download/{index}.metadata"
    first = note.read_text().split("\n", 1)[0].strip() if note.is_file() else folder.resolve().name
    return first if re.fullmatch(r"[0-9a-f]{40}", first) else None


def _get_it(origin: Origin, repository: str | None = None, revision: str | None = None) -> str:
    which = f"{repository or origin.repository}{f' --revision {revision}' if revision else ''}"
    return (
        f"It comes under {origin.licence}: if you may use it, `.venv/bin/hf download {which}` puts it into the cache,"
        f" with `--local-dir <folder>` into a folder ({origin.page})"
    )


# ------------------------------------------------------------------------------------------------------------------ what


def _check_classes(folder: Path, index: dict[str, Any], recipe: Recipe) -> None:
    path, found = folder / "model_index.json", index.get("_class_name")
    if found != recipe.pipeline:
        raise InputError(
            f"{path}: `_class_name` is {found}, but `prior: {{kind: {recipe.kind}}}` needs {recipe.pipeline}: this is another"
            f" model. {recipe.repository} is the one that is meant"
        )
    for component, needed in COMPONENTS.items():
        entry = index.get(component)
        name = entry[1] if isinstance(entry, list) and len(entry) == 2 else entry
        made_anew = component == "scheduler" and recipe.scheduler  # DDIM is built from the settings of any scheduler
        if name not in (needed, f"{needed}Fast") and not made_anew:
            raise InputError(f"{path}: `{component}` is {name}, needed {needed}; only this kind of it is read here")
        if not (folder / component).is_dir():
            raise InputError(f"{folder / component}: not found; the checkpoint is incomplete, download it again")


def _check_channels(folder: Path, targets: int, unet: dict[str, Any], recipe: Recipe) -> None:
    for path, key, needed in (
        ("unet/config.json", "in_channels", (1 + targets) * LATENT),
        ("unet/config.json", "out_channels", targets * LATENT),
        ("vae/config.json", "latent_channels", LATENT),
        ("scheduler/scheduler_config.json", "prediction_type", "v_prediction"),
    ):
        found = read_json(folder / path, recipe).get(key)
        if found != needed:
            raise InputError(f"{folder / path}: `{key}` is {found}, needed {needed}: this is another model")
    stored = unet.get("conv_in.weight", {}).get("shape", [0, 0])[1]
    if stored != (1 + targets) * LATENT:
        raise InputError(
            f"{folder / 'unet'}: the weights read {stored} channels, its config.json says {(1 + targets) * LATENT}:"
            " files of two models; download it again"
        )


def weights_in(folder: Path, stem: str) -> Path:
    """Return the safetensors file of a folder."""
    names = (f"{stem}.safetensors", f"{stem}.fp16.safetensors")
    for name in names:
        if (folder / name).is_file():
            return folder / name
    pickled = next(folder.glob("*.bin"), None)
    why = f" ({pickled.name} is a pickle, which can run code when it is read: not opened)" if pickled else ""
    raise InputError(f"{folder}: no {' or '.join(names)}{why}; download the checkpoint with its safetensors files")


LONGEST_HEADER = 100 << 20
"""Bytes of the header of a safetensors file, as the format allows."""


def tensor_header(path: Path) -> dict[str, Any]:
    """Return names, types and shapes of the tensors in a safetensors file, after checking its size against them."""
    size = check_file(path, 1 << 40, "weights (safetensors)")
    with path.open("rb") as file:
        start = file.read(8)
        length = struct.unpack("<Q", start)[0] if len(start) == 8 else math.inf
        if length > min(size - 8, LONGEST_HEADER):
            pointer = start.startswith(b"version ")
            lfs, damaged = "a pointer of git-lfs: run `git lfs pull` there", "cut short, or not safetensors: download it again"
            why = lfs if pointer else damaged
            raise InputError(f"{path}: {size} bytes, {why}")
        try:
            tensors = json.loads(file.read(length))
            tensors.pop("__metadata__", None)
            needed = 8 + length + max(entry["data_offsets"][1] for entry in tensors.values())
        except (ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError):
            raise InputError(f"{path}: not a safetensors file; download it again") from None
    if size != needed:
        raise InputError(f"{path}: {size} bytes, its header says {needed}: cut short, download it again")
    return tensors


def read_json(path: Path, origin: Origin) -> dict[str, Any]:
    """Read a document of a checkpoint."""
    try:
        document = json.loads(path.read_text())
    except FileNotFoundError:
        raise InputError(
            f"{path}: not found; `{origin.section}.checkpoint` needs a folder in {origin.layout} ({origin.page})"
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: not readable as JSON ({error}); download the checkpoint again") from None
    if not isinstance(document, dict):
        raise InputError(f"{path}: holds {type(document).__name__}, needed `key: value` pairs; download the checkpoint again")
    return document


def _terms(folder: Path) -> str:
    """Return where the terms of a checkpoint can be read."""
    named = sorted(path.name for path in folder.iterdir() if path.name.lower().startswith(("license", "licence")))
    if named:
        return f"read {folder / named[0]}"
    card = folder / "README.md"
    said = re.search(r"^license(?:_name)?:\s*(\S+)", card.read_text(errors="replace"), re.MULTILINE) if card.is_file() else None
    return f"its model card says `{said[1]}`: read the terms" if said else "read the terms where you got it"
