"""`mitsuba-diffraction render`: a spectral picture of a scene, or those of an animation."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import RequestError
from ..files.outputs import check_outputs, free_name
from ..machine import available_memory
from ..progress import bytes_text, durations, progress_bar, say, stage, takes_long, tell, time_text
from .arguments import (
    Define,
    Overwrite,
    Variant,
    as_command,
    check_suffix,
    named_as_options,
    replacements_of,
    scene_parameters,
)

if TYPE_CHECKING:
    import mitsuba as mi

    from ..optics.color import ViewTransform
    from ..render.passes import Estimate
    from ..render.scene_file import SceneFile
    from ..render.spectral_image import SpectralImage

_log = logging.getLogger(__name__)
MIN_WARNED_SECONDS = 3600
_MIN_MEMORY = 400_000_000  # bytes, of Mitsuba and its compiler, without which they end in crashes


class Stopped(Exception):
    """Interruption by Ctrl-C or SIGTERM after something has been saved; the text names it."""


@dataclass(frozen=True)
class RenderRequest:
    """What `render` was asked for: its arguments and options."""

    scene: Annotated[Path, typer.Argument(metavar="SCENE.xml")]
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", help="spectral picture (.exr), or the preview alone (.png, .jpg); default: ./SCENE.exr"
        ),
    ] = None
    spp: Annotated[
        int | None,
        typer.Option(
            min=1, help="samples per pixel, the maximum with --until-error; default: sample_count of the scene, or 64"
        ),
    ] = None
    width: Annotated[int | None, typer.Option(min=1, help="pixels; default: that of the scene")] = None
    height: Annotated[int | None, typer.Option(min=1, help="pixels; default: that of the scene")] = None
    variant: Variant = None
    seed: Annotated[int, typer.Option(min=0, help="seed of the random numbers")] = 0
    define: Define = None
    material: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ID=SURFACE[,name=value…]",
            help="replace the BSDF of this id by a grating: a recipe, profile or spectrum; name=value: its parameters",
        ),
    ] = None
    until_error: Annotated[
        float | None, typer.Option(metavar="ERROR", help="stop at this relative standard error of luminance, e.g. 0.01")
    ] = None
    resume: Annotated[bool, typer.Option("--resume", help="resume an interrupted run of the same command")] = False
    checkpoint: Annotated[float, typer.Option(min=0, metavar="SECONDS", help="interval between checkpoints")] = 60
    single: Annotated[
        bool, typer.Option("--float", help="write float32; default: float16, unless it rounds by more than 0.05 %")
    ] = False
    rgb: Annotated[bool, typer.Option("--rgb", help="write only R, G, B, as float16: at most 6 bytes per pixel")] = (
        False
    )
    channels: Annotated[
        int | None,
        typer.Option(min=2, metavar="N", help="write at most N wavelengths (46, 30, 22, …), each over a wider band"),
    ] = None
    exposure: Annotated[
        float | None,
        typer.Option(min=-99, max=99, metavar="STOPS", help="multiply the preview by 2^STOPS; default: automatic"),
    ] = None
    view: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="preview by a filmic view of OpenColorIO, such as ACES or, with Blender's $OCIO, AgX (extra: ocio)",
        ),
    ] = None
    denoise: Annotated[
        bool | None,
        typer.Option(
            help="denoise the preview, but not the spectral picture (extra: denoise); default: as in the scene, or no"
        ),
    ] = None
    dask: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="distribute the passes over a Dask cluster (tcp://HOST:PORT)")
    ] = None
    # 3600 frames are a tenth of a degree apart, and last five minutes.
    frames: Annotated[
        int | None,
        typer.Option(
            min=2,
            max=3600,
            metavar="N",
            help="pictures of an animation: of --orbit, or of values first:last (-D turn=0:90)",
        ),
    ] = None
    orbit: Annotated[bool, typer.Option("--orbit", help="with --frames, move the camera around the scene")] = False
    overwrite: Overwrite = False

    def __post_init__(self) -> None:
        if self.rgb and self.channels is not None:
            raise RequestError("--rgb writes no wavelengths: wanted --rgb or --channels N")
        if self.output is not None:
            check_suffix("-o", self.output, ".exr", ".png", ".jpg")
            options = {"--float": self.single, "--rgb": self.rgb, "--channels": self.channels is not None}
            if not _is_spectral(self.output) and any(options.values()):
                named = ", ".join(option for option, given in options.items() if given)
                raise RequestError(f"{named}: how an .exr is stored; got {self.output}, a picture of eight bits")
        if self.orbit and self.frames is None:
            raise RequestError("--orbit: wanted --frames N with it")

    @property
    def stored(self) -> dict[str, Any]:
        """How an .exr is stored: arguments of `SpectralImage.save`."""
        return {"half": False if self.single else None, "rgb": self.rgb, "channels": self.channels}

    def _parameters(self) -> tuple[dict[str, str], str | None]:
        """Return the parameters of the scene, and that of denoising, where nothing else refers to it."""
        from ..render.denoise import default_of

        parameters = scene_parameters(self.define)
        # Mitsuba refuses a parameter that nothing refers to.
        given = parameters.pop("denoise", None) if self.scene.is_file() and default_of(self.scene) else None
        return parameters, given

    def denoises(self) -> bool:
        """Return whether the preview is denoised: as requested, or as in the scene if the denoiser is installed."""
        from ..render.denoise import is_requested

        if self.denoise is not None:
            return self.denoise
        return is_requested(self.scene, self._parameters()[1]) and _can_denoise()

    def scene_files(self) -> list[SceneFile]:
        """Return the scene of each frame."""
        from ..render.animation import frames_of
        from ..render.scene_file import SceneFile

        size = self.width, self.height
        scene_file = SceneFile(self.scene, self._parameters()[0], replacements_of(self.material), size)
        if self.frames is None:
            return [scene_file]
        frames = frames_of(scene_file, self.frames)
        if not self.orbit and frames[0] == frames[-1]:
            raise RequestError("--frames N: wanted --orbit, or a value that changes, such as -D turn=0:90")
        return frames

    def target(self, reads: list[Path]) -> Path:
        """Return the path of the picture, or the path from which those of an animation are named, if all is free.

        Args:
            reads: files that the command reads.
        """
        from ..render.sums import checkpoint_path

        named = free_name(self.scene.stem, lambda stem: _outputs(Path(f"{stem}.exr"), self.frames), reads)
        target = self.output or Path(named + ".exr")
        check_outputs(reads, [("-o", path) for path in _outputs(target, self.frames)], overwrite=self.overwrite)
        checkpoints = [path for path in map(checkpoint_path, _pictures(target, self.frames)) if path.exists()]
        if checkpoints and not self.resume:
            raise RequestError(
                f"{checkpoints[0]} is of an unfinished rendering: --resume continues it; remove it to start over"
            )
        return target


@dataclass(frozen=True)
class _Rendering:
    """What all pictures of a command have in common.

    Attributes:
        request: of the command.
        arguments: of `passes.render`, for the first picture.
        denoise: the preview.
        view: of the preview.
    """

    request: RenderRequest
    arguments: Mapping[str, Any]
    denoise: bool
    view: ViewTransform


@as_command(RenderRequest)
def render(request: RenderRequest) -> None:
    """Path-trace a scene into a spectral picture (.exr) with a preview (.png), or into a picture alone (.png, .jpg)."""
    from ..optics.color import neutral_view, ocio_view

    # Before Mitsuba, which takes more than a second to start.
    with named_as_options({"view": "--view"}):
        shown = neutral_view if request.view is None else ocio_view(request.view)
    if (available := available_memory()) is not None and available < _MIN_MEMORY:
        raise RequestError(
            f"memory: got {bytes_text(available)} that are available, wanted at least {bytes_text(_MIN_MEMORY)}"
        )

    import mitsuba as mi

    from ..render.replacements import check_replacements
    from ..variants import choose_variant

    scene_files = request.scene_files()
    target = request.target([*scene_files[0].files(), *scene_files[-1].files()])
    mi.set_variant(choose_variant(request.variant))
    denoise = request.denoises()
    arguments = _arguments(request, scene_files[0], target)
    with scene_files[-1].parsed():  # before all others are rendered
        check_replacements(scene_files[-1].replacements)
    _render_all(_Rendering(request, arguments, denoise, shown), scene_files, target)


def _arguments(request: RenderRequest, scene_file: SceneFile, target: Path) -> dict[str, Any]:
    """Return the arguments of `passes.render` for a scene; `target` is the picture."""
    from ..render.cluster import trace_on
    from ..render.passes import trace_locally

    named = None if request.spp else scene_file.sample_count()
    tracer = trace_locally if request.dask is None else trace_on(request.dask)
    alpha = scene_file.has_alpha()
    if alpha and target.suffix.lower() == ".jpg":
        raise RequestError(f"-o: got {target}, but the scene has alpha, which JPEG has not; wanted .exr or .png")
    arguments: dict[str, Any] = {"spp": request.spp or named or 64, "seed": request.seed}
    arguments |= {"until_error": request.until_error, "seconds": request.checkpoint, "tracer": tracer}
    if request.until_error is None:  # else nobody knows the time
        written = request.channels if _is_spectral(target) and not request.rgb else 0
        size = 1 if not _is_spectral(target) else 4 if request.single and not request.rgb else 2
        arguments["announce"] = partial(_announce, request.scene.name, size, 3 + alpha, written, named)
    return arguments


def _render_all(rendering: _Rendering, scene_files: list[SceneFile], target: Path) -> None:
    """Render the picture of a command, or those of its animation."""
    from ..render.animation import animations_of, save_animation
    from ..render.animation import orbit as motions_of_orbit
    from ..render.passes import deferred_interrupt

    request, scene = rendering.request, rendering.request.scene.name
    count = len(scene_files)
    motions = motions_of_orbit(scene_files[0], count) if request.orbit else [None] * count
    pictures = _pictures(target, request.frames)
    # By default all pictures have the exposure of the first.
    factor = None if request.exposure is None else 2**request.exposure
    with durations(), named_as_options({"until_error": "--until-error", "spp": "--spp"}):
        for number, (path, frame, motion) in enumerate(zip(pictures, scene_files, motions, strict=True)):
            begin = time.perf_counter()
            factor = _picture(
                rendering,
                frame.viewed(motion=motion),
                path,
                label=scene if count == 1 else f"{scene} {number + 1}/{count}",
                exposure=factor,
                complete=f"{number} of {count} pictures are complete" if number else None,
            )
            if number == 0:
                if not request.resume:
                    _announce_others(scene, count - 1, time.perf_counter() - begin)
                others = {name: value for name, value in rendering.arguments.items() if name != "announce"}
                rendering = replace(rendering, arguments=others)
        if request.frames is not None:
            with deferred_interrupt():
                for animation in animations_of(target):
                    save_animation([_preview(path) for path in pictures], animation)
                    tell(f"{animation}: animated preview, {request.frames} frames")


def _announce(
    label: str, bytes_per_number: int, planes: int, wavelengths: int | None, named: int | None, estimate: Estimate
) -> None:
    """Print what a rendering needs that goes on for more than a few seconds.

    Args:
        planes: of the picture, in addition to one for each of its `wavelengths` (None: all).
        named: the sample count, if the scene names it.
    """
    if not takes_long(estimate.seconds):
        return
    planes += estimate.channels if wavelengths is None else wavelengths
    size = bytes_per_number * planes * estimate.columns * estimate.rows
    disk = f", {bytes_text(estimate.disk)} of disk meanwhile" if estimate.disk else ""
    say(
        label,
        f"{estimate.columns} × {estimate.rows} pixels, {estimate.spp} samples per pixel: about "
        f"{time_text(estimate.seconds)}, {bytes_text(estimate.memory)} of memory{disk}, a picture of "
        f"{bytes_text(size)} before compression",
    )
    if named is not None and estimate.seconds > MIN_WARNED_SECONDS:
        _log.warning(
            "the scene's own %d samples per pixel take about %.1f hours; --spp sets fewer, --until-error stops earlier",
            named,
            estimate.seconds / 3600,
        )


def _announce_others(label: str, pictures: int, seconds: float) -> None:
    """Print how long the other pictures of an orbit take, from the time of the first."""
    if pictures and takes_long(pictures * seconds):
        say(label, f"other pictures ({pictures}): about {time_text(pictures * seconds)}")


def _can_denoise() -> bool:
    """Return whether the denoiser is installed."""
    from ..render.denoise import check_requirements

    with suppress(RequestError):
        check_requirements()
        return True
    return False


def _is_spectral(path: Path) -> bool:
    """Return whether a picture is to be stored spectrally; if not, its preview is all that is written."""
    return path.suffix.lower() == ".exr"


def _preview(path: Path) -> Path:
    """Return the path of the preview of a picture: next to it, or the picture itself."""
    return path.with_suffix(".png") if _is_spectral(path) else path


def _pictures(target: Path, frames: int | None) -> list[Path]:
    """Return the paths of the pictures: `target`, or the paths of its frames, `target_007.exr`."""
    if frames is None:
        return [target]
    digits = max(3, len(str(frames - 1)))
    return [target.with_name(f"{target.stem}_{frame:0{digits}d}{target.suffix}") for frame in range(frames)]


def _outputs(target: Path, frames: int | None) -> list[Path]:
    """Return all files that the command writes."""
    pictures = _pictures(target, frames)
    previews = [_preview(path) for path in pictures if _is_spectral(path)]
    if frames is None:
        return [*pictures, *previews]
    from ..render.animation import animations_of

    return [*pictures, *previews, *animations_of(target)]


def _picture(
    rendering: _Rendering,
    scene_file: SceneFile,
    path: Path,
    *,
    label: str,
    exposure: float | None,
    complete: str | None,
) -> float | None:
    """Render, save and report one picture; return the exposure of its preview, if it is known.

    Args:
        rendering: of the command.
        scene_file: of this picture.
        path: of this picture.
        label: of its progress.
        exposure: of the preview; None: `auto_exposure`.
        complete: number of completed pictures, as text to report if Ctrl-C interrupts this one.
    """
    from ..render.denoise import check_requirements
    from ..render.passes import Finished, Interrupted, deferred_interrupt
    from ..render.passes import render as trace
    from ..render.spectral_image import exposure_of_preview, save_preview, stored_digest
    from ..render.sums import checkpoint_path, discard_checkpoints

    start = time.perf_counter()
    request, view, arguments = rendering.request, rendering.view, dict(rendering.arguments)
    checkpoint, preview = checkpoint_path(path), _preview(path)
    earlier = stored_digest(path) if request.resume and path.is_file() and not checkpoint.exists() else None
    scenes: list[mi.Scene] = []
    if rendering.denoise:
        with named_as_options({"denoise": "--denoise"}):
            check_requirements()
        arguments["on_load"] = partial(_keep, scenes)
    interrupted = False
    try:
        with progress_bar(label, "spp", "loading and compiling") as progress:
            image = trace(
                scene_file,
                **arguments,
                checkpoint=checkpoint,
                finished=earlier,
                progress=progress,
                on_checkpoint=partial(save_preview, path=preview, exposure=exposure, view=view),
            )
    except Finished:
        tell(f"{path}: complete, nothing to do")
        return exposure if exposure is not None else exposure_of_preview(preview)
    except Interrupted as error:
        image, interrupted = error.image, True
    except KeyboardInterrupt:
        if checkpoint.exists():
            complete = f"{checkpoint} holds the samples so far"
        if complete is None:
            raise
        raise Stopped(f"{complete}; the same command with --resume continues") from None
    # Written to the end, as no checkpoint holds the last samples.
    with deferred_interrupt() as pressed:
        exposure = _write(rendering, image, path, exposure, scenes)
    if interrupted:
        spp = image.attributes["spp"]
        raise Stopped(f"{path} holds {spp} samples per pixel; the same command with --resume continues")
    discard_checkpoints(checkpoint)
    tell(_report(rendering, image, path, exposure, time.perf_counter() - start))
    if pressed():
        raise Stopped(f"{path} is complete")
    return exposure


def _write(
    rendering: _Rendering, image: SpectralImage, path: Path, exposure: float | None, scenes: list[mi.Scene]
) -> float:
    """Write a picture and its preview, denoised by the guides of the scene, if there is one; return its exposure.

    Raises:
        RuntimeError: if one of them cannot be written.
    """
    from ..render.denoise import denoised_picture
    from ..render.spectral_image import save_preview
    from ..render.sums import checkpoint_path

    try:
        if _is_spectral(path):
            with stage("writing"):
                image.save(path, **rendering.request.stored)
        with stage("preview"):
            clean = partial(denoised_picture, scenes[0]) if scenes else None
            return save_preview(image, _preview(path), exposure, clean, rendering.view)
    except (OSError, RuntimeError) as error:
        checkpoint = checkpoint_path(path)
        kept = f"; {checkpoint} is kept, and --resume continues from it" if checkpoint.exists() else ""
        written = f"{path} or its preview" if _is_spectral(path) else str(path)
        raise RuntimeError(f"{written} cannot be written ({error}){kept}") from error


def _report(rendering: _Rendering, image: SpectralImage, path: Path, exposure: float, seconds: float) -> str:
    """Return what is printed of a picture that is complete."""
    from ..render.spectral_image import wider_hats

    request, channels = rendering.request, "8 bits"
    if _is_spectral(path):
        wanted, count = request.channels, image.shape[2]
        count = count if wanted is None else wider_hats(count, wanted).shape[1]
        channels = "RGB" if request.rgb else f"{count} wavelengths"
    stops = math.log2(exposure)
    exposed = ("denoised, " if rendering.denoise else "") + f"exposed by {stops:+.2f} stops (--exposure {stops:.2f})"
    summary = _summary(image, request.until_error, channels)
    text = f"{path}: {summary}, {seconds:.1f} s, {bytes_text(path.stat().st_size)}"
    return text + (f"\n{_preview(path)}: preview, {exposed}" if _is_spectral(path) else f", {exposed}")


def _keep(scenes: list[mi.Scene], scene: mi.Scene) -> None:
    """Keep a scene for the denoiser, once its guides of the first row show that it can be denoised."""
    from ..render.denoise import guides

    guides(scene, (0, 1))
    scenes.append(scene)


def _summary(image: SpectralImage, until_error: float | None, channels: str) -> str:
    """Return size, channels as stored, samples and noise of a picture."""
    rows, columns, _ = image.shape
    text = f"{columns} × {rows} pixels, {channels}, {image.attributes['spp']} samples per pixel"
    if "error" in image.attributes:
        error = float(image.attributes["error"])
        text += f", noise at most {100 * error:.2g} % of the luminance in nine of ten pixels"
        if until_error is not None and error > until_error:
            text += f" (above {100 * until_error:g} %: increase --spp)"
    return f"{text}, {image.attributes['variant']}"
