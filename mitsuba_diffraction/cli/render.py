"""`mitsuba-diffraction render`: a spectral picture of a scene, or one per camera position of an orbit."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from ..errors import RequestError
from ..outputs import free_name
from .arguments import Define, Overwrite, Variant, check_suffix, claim, materials_of, scene_parameters
from .console import Stopped, progress_bar, tell


def render(
    context: typer.Context,
    scene: Annotated[Path, typer.Argument(metavar="SCENE.xml")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="spectral picture (.exr)")] = None,
    spp: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="samples per pixel, the maximum with --until-error; default: sample_count of the scene, or 64",
        ),
    ] = None,
    width: Annotated[int | None, typer.Option(min=1, help="pixels; default: that of the scene")] = None,
    height: Annotated[int | None, typer.Option(min=1, help="pixels; default: that of the scene")] = None,
    variant: Variant = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    define: Define = None,
    material: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ID=RECIPE|PROFILE[,name=value…]",
            help="put a grating in the place of the BSDF of that id; name=value: its parameters",
        ),
    ] = None,
    until_error: Annotated[
        float | None, typer.Option(metavar="ERROR", help="stop at this relative standard error of luminance, e.g. 0.01")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="resume an interrupted run of the same command")] = False,
    checkpoint: Annotated[float, typer.Option(min=0, metavar="SECONDS", help="interval between checkpoints")] = 60,
    half: Annotated[
        bool, typer.Option("--half", help="write float16: half the size, radiance rounded by up to 0.05 %")
    ] = False,
    denoise: Annotated[
        bool, typer.Option("--denoise", help="denoise the preview, but not the spectral picture (extra: denoise)")
    ] = False,
    dask: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="distribute the passes over a Dask cluster (tcp://HOST:PORT)")
    ] = None,
    frames: Annotated[int | None, typer.Option(min=2, max=3600, metavar="N", help="frames of an orbit")] = None,
    orbit: Annotated[bool, typer.Option("--orbit", help="orbit the scene once")] = False,
    overwrite: Overwrite = False,
) -> None:
    """Path-trace a scene into a spectral picture (.exr) with a preview (.png)."""
    import mitsuba as mi

    from ..llvm import choose_variant
    from ..render.denoise import guides as guides_of
    from ..render.passes import Interrupted, checkpoint_path, trace_here
    from ..render.passes import render as trace
    from ..render.preview import save_preview
    from ..render.scene import files_of_scene, load_spectral_scene, named_sample_count
    from ..render.spectral_image import SpectralImage
    from ..render.turntable import frame_path, save_animation
    from ..render.turntable import orbit as motions_of_orbit

    if output is not None:
        check_suffix("-o", output, ".exr")
    if (frames is not None) != orbit:
        raise RequestError("--frames N and --orbit go together")
    parameters = scene_parameters(define)
    materials = materials_of(material)
    reads = files_of_scene(scene, parameters, materials)

    def pictures(target: Path) -> list[Path]:
        return [target] if frames is None else [frame_path(target, frame, frames) for frame in range(frames)]

    def written(target: Path) -> list[Path]:
        previews = [path.with_suffix(".png") for path in pictures(target)]
        return [*pictures(target), *previews, *([] if frames is None else [target.with_suffix(".webp")])]

    target = output or Path(free_name(scene.stem, lambda stem: written(Path(f"{stem}.exr")), reads) + ".exr")
    targets, animation = pictures(target), target.with_suffix(".webp")
    claim(context, reads, [("-o", path) for path in written(target)])
    for path in targets:
        if checkpoint_path(path).exists() and not resume:
            raise RequestError(
                f"{checkpoint_path(path)} is of an unfinished rendering: --resume continues it; remove it to start over"
            )
    mi.set_variant(choose_variant(variant))
    if spp is None:
        spp = named_sample_count(scene, parameters) or 64
    tracer = trace_here
    if dask is not None:
        from ..render.cluster import trace_on

        tracer = trace_on(dask)
    motions = [None] if frames is None else motions_of_orbit(scene, frames, parameters, materials)

    where = {"width": width, "height": height, "parameters": parameters, "materials": materials}
    exposure = None
    for number, (path, motion) in enumerate(zip(targets, motions, strict=True)):
        start = time.perf_counter()
        waiting = checkpoint_path(path)
        label = scene.name if frames is None else f"{scene.name} {number + 1}/{frames}"
        earlier = SpectralImage.load(path) if resume and path.is_file() and not waiting.exists() else None
        guides, interrupted = None, False
        if denoise:
            guides = guides_of(load_spectral_scene(scene, **where, motion=motion))
        try:
            with progress_bar(label, "spp", "loading and compiling") as progress:
                image = trace(
                    scene,
                    spp=spp,
                    **where,
                    seed=seed,
                    motion=motion,
                    until_error=until_error,
                    checkpoint=waiting,
                    seconds=checkpoint,
                    finished=earlier,
                    tracer=tracer,
                    progress=progress,
                )
        except Interrupted as error:
            image, interrupted = error.image, True
        except KeyboardInterrupt:
            if waiting.exists():
                kept = f"{waiting} holds the samples so far"
            elif number:
                kept = f"{number} of {frames} pictures are complete"
            else:
                raise
            raise Stopped(f"{kept}; the same command with --resume continues") from None
        preview = path.with_suffix(".png")
        try:
            if image is not earlier:
                image.save(path, half=half)
            exposure = save_preview(image, preview, exposure, guides)
        except (OSError, RuntimeError) as error:
            kept = f"; {waiting} is kept, and --resume continues from it" if waiting.exists() else ""
            raise RuntimeError(f"{path} or its preview cannot be written ({error}){kept}") from error
        if interrupted:
            spp = image.attributes["spp"]
            raise Stopped(f"{path} holds {spp} samples per pixel; the same command with --resume continues")
        waiting.unlink(missing_ok=True)
        rows, columns, bins = image.radiance.shape
        done = f"{image.attributes['spp']} samples per pixel"
        if "error" in image.attributes:
            done += f", relative error of luminance at most {image.attributes['error']:.2g} in 90 % of the pixels"
            if until_error is not None and image.attributes["error"] > until_error:
                done += f" (above {until_error:g}: increase --spp)"
        tell(
            f"{path}: {columns} × {rows} pixels, {bins} wavelengths, {done}, {mi.variant()}, "
            f"{time.perf_counter() - start:.1f} s, {path.stat().st_size / 1e6:.3g} MB\n"
            f"{preview}: preview, radiance times {exposure:.4g} (exposure)"
        )
    if frames is not None:
        save_animation([path.with_suffix(".png") for path in targets], animation)
        tell(f"{animation}: animated preview, {frames} frames")
