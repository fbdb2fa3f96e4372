"""The command line: `scan`, and `process`, `compare`, `paper`, `plan`, `study`, `doctor`, `preview`, `latency` below.

Exit codes: 0 done; 2 bad configuration or usage; 3 hardware; 4 the scan ran but its result fails its own quality gates;
130 interrupted. Everything heavy is imported where it is used, so that `scan --help` answers at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from scanner.command_line import (
    ConfigOption,
    OverwriteOption,
    QuietOption,
    SetOption,
    interruptible,
    new_app,
    overrides,
    run,
)

if TYPE_CHECKING:
    from scanner.config import GatesSection, LoadedConfig, ScanSection
    from scanner.patterns import Axis
    from scanner.result import ScanResult
    from scanner.terminal import Terminal

app = new_app()

study_app = typer.Typer(
    help="Studies on ideal signals: what a rule can do.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.add_typer(study_app, name="study")

NOT_READY = 3
GATES_FAILED = 4


@app.callback(invoke_without_command=True)
@interruptible
def scan(
    context: typer.Context,
    config: Annotated[Path | None, typer.Option("--config", "-c", help="Bench file (YAML).")] = None,
    method: Annotated[
        str | None, typer.Option("--method", "-m", help="Name of a method, such as mfs or tps, or FILE.py.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Result folder; default: scan-<time>.")] = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    sets: SetOption = None,
) -> None:
    """Scan: project, photograph, compute, and write a result folder with point cloud and report."""
    if context.invoked_subcommand is not None:
        return
    if config is None:
        typer.echo(context.get_help())
        raise typer.Exit(2)
    from scanner.config import load_config
    from scanner.terminal import Terminal

    loaded = load_config(config, overrides(sets, None if method is None else _known(method)))
    terminal = Terminal(quiet)
    terminal.say(loaded.warnings)
    result, path = _scan(loaded, out or _default_out("scan"), overwrite, terminal)
    terminal.table(result, path)
    _exit_by_gates(result)


@app.command()
@interruptible
def process(
    source: Annotated[Path, typer.Argument(help="A take, a result folder that holds one, or a folder of images.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Result folder; default: process-<time>.")] = None,
    config: Annotated[Path | None, typer.Option("--config", "-c", help="Its scan section replaces the take's.")] = None,
    plan: Annotated[Path | None, typer.Option("--plan", help="Plan file of a folder of images.")] = None,
    rig: Annotated[Path | None, typer.Option("--rig", help="Rig: own JSON or OpenCV FileStorage.")] = None,
    method: Annotated[
        str,
        typer.Option("--method", "-m", help="How images are decoded: tps, mps, mfs …; or FILE.py of a take's method."),
    ] = "tps",
    min_modulation: Annotated[
        float | None, typer.Option("--min-modulation", help="Least fringe modulation of a valid pixel, DN.")
    ] = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Compute everything after acquisition from recorded frames: a take, as far as it goes, or a folder of images."""
    from scanner.folder import ResultFolder, write_result
    from scanner.rig import Rig
    from scanner.take import MANIFEST, Take
    from scanner.terminal import Terminal

    terminal = Terminal(quiet)
    method = _known(method)
    if (source / "take" / MANIFEST).exists():
        source = source / "take"
    chosen_rig = Rig.load(rig) if rig is not None else None
    scan_section, gates = _sections(source, config, method, min_modulation)
    with ResultFolder(out or _default_out("process"), overwrite=overwrite) as folder:
        if (source / MANIFEST).exists() or (source / "journal.jsonl").exists():
            from scanner.processing import process_take

            take = Take.open(source)
            terminal.say(take.describe())
            document = take.manifest.get("rig")
            if chosen_rig is None and document is not None:
                chosen_rig = Rig.from_json(document)
            with terminal.working() as report:
                result = process_take(take, scan_section, gates, chosen_rig, report)
        else:
            from scanner.images import open_images
            from scanner.processing import process_images

            recorded = open_images(source, plan)
            if chosen_rig is None and recorded.rig_path is not None:
                chosen_rig = Rig.load(recorded.rig_path)
            with terminal.working() as report:
                result = process_images(recorded, scan_section, gates, chosen_rig, report)
        if chosen_rig is None:
            result.warnings.append(
                "no rig is known: the result has projector coordinates and no points; name one with --rig"
            )
        with terminal.working() as report:
            report("writing the result folder")
            write_result(folder.path, result, rig=chosen_rig)
    for notice in folder.notices:
        terminal.note(notice)
    terminal.table(result, folder.out)
    _exit_by_gates(result)


@app.command()
@interruptible
def compare(
    config: ConfigOption,
    methods: Annotated[
        str | None, typer.Option("--methods", help="Comma-separated names, or files FILE.py; default: compare.methods.")
    ] = None,
    seeds: Annotated[int | None, typer.Option("--seeds", min=1, help="Scans of each method, for intervals.")] = None,
    fit: Annotated[str | None, typer.Option("--fit", help="plane or sphere, where no window is configured.")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder; default: comparison-<time>.")] = None,
    reuse: Annotated[
        Path | None, typer.Option("--reuse", help="A result folder of this scene: its method is not scanned again.")
    ] = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    sets: SetOption = None,
) -> None:
    """Scan with several methods: one table of errors, one report with the figures, over several seeds."""
    from scanner.comparison.running import Planned, plan_scans, run_comparison
    from scanner.config import load_config
    from scanner.folder import ComparisonFolder, read_result
    from scanner.terminal import Terminal

    terminal = Terminal(quiet)
    changes = overrides(sets)
    if methods is not None:
        changes["compare.methods"] = [_known(name.strip()) for name in methods.split(",") if name.strip()]
    if seeds is not None:
        changes["compare.seeds"] = seeds
    if fit is not None:
        changes["compare.fit"] = fit
    section = load_config(config, changes).config.compare
    scans = plan_scans(
        lambda more: load_config(config, {**changes, **more}), section.methods, section.seeds, section.reference
    )
    known = None if reuse is None else read_result(reuse)
    command = ["scan", "compare", "--config", str(config), "--methods", methods or ",".join(section.methods)]
    command += ["--seeds", str(section.seeds), *(word for s in sets or [] for word in ("--set", s))]
    command += ["--fit", fit] if fit is not None else []
    with ComparisonFolder(out or _default_out("comparison"), overwrite=overwrite) as folder:

        def scan(planned: Planned) -> ScanResult:
            if known is not None and planned.number == 0 and planned.name == known.method:
                return known
            terminal.say([f"{planned.name}, scan {planned.number + 1} of {section.seeds}"])
            return _scan(planned.loaded, folder.path / planned.folder, False, terminal)[0]

        rows = run_comparison(scans, scan, section, folder, command)
    terminal.comparison(rows, folder.out)


@app.command()
@interruptible
def paper(
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder; one that an earlier run left is gone on with.")
    ] = Path("paper-result"),
    configs: Annotated[Path, typer.Option("--configs", help="Folder of the experiments' bench files.")] = Path(
        "configs/paper"
    ),
    seeds: Annotated[
        int | None, typer.Option("--seeds", min=1, help="Scans of each method in each experiment; default: 3.")
    ] = None,
    width_px: Annotated[
        int | None, typer.Option("--width-px", min=64, help="Columns of the camera; default: those of the files.")
    ] = None,
    small: Annotated[bool, typer.Option("--small", help="A quick look: 256 columns, one seed.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Begin anew instead of going on.")] = False,
    quiet: QuietOption = False,
) -> None:
    """Make the experiments of the paper again, all methods side by side, into one report beside what it says."""
    from dataclasses import replace

    from scanner.comparison.running import Planned
    from scanner.paper.running import Wanted, run_paper
    from scanner.terminal import Terminal

    terminal = Terminal(quiet)
    wanted = Wanted(seeds or 3, width_px)
    if small:
        wanted = replace(wanted, seeds=seeds or 1, width_px=width_px or 256, noise_shape=(192, 256))
    command = ["scan", "paper", "--configs", str(configs), *(["--small"] if small else [])]
    command += [] if seeds is None else ["--seeds", str(seeds)]
    command += [] if width_px is None else ["--width-px", str(width_px)]

    def scan(planned: Planned, place: Path) -> ScanResult:
        return _scan(planned.loaded, place, True, terminal)[0]

    document = run_paper(configs, out, wanted, scan, lambda text: terminal.say([text]), overwrite, command)
    terminal.paper(document, out)


@app.command()
@interruptible
def plan(
    frames: Annotated[int, typer.Option("--frames", help="Frames of one round, all axes together, at most.")] = 108,
    from_px: Annotated[
        float, typer.Option("--from-px", help="Least distance between the two paths of a pixel, projector px.")
    ] = 16,
    to_px: Annotated[float, typer.Option("--to-px", help="Largest such distance, projector px.")] = 600,
    width_px: Annotated[int, typer.Option("--width-px", help="Projector width, px.")] = 1280,
    height_px: Annotated[int, typer.Option("--height-px", help="Projector height, px.")] = 800,
    noise_dn: Annotated[float, typer.Option("--noise-dn", help="Standard deviation of a frame's noise, DN.")] = 1.5,
    modulation_dn: Annotated[float, typer.Option("--modulation-dn", help="Fringe modulation B, DN.")] = 80,
    false_alarm_rate: Annotated[float, typer.Option("--false-alarm-rate", help="Of the detection, 0..1.")] = 0.01,
    alpha: Annotated[float, typer.Option("--alpha", help="Bounce over direct light, for the table's power.")] = 0.05,
    axes: Annotated[str, typer.Option("--axes", help="x, y or x,y.")] = "x,y",
    min_steps: Annotated[int, typer.Option("--min-steps", help="Fewest phase steps; from 4 on, faults show.")] = 4,
    max_steps: Annotated[int, typer.Option("--max-steps", help="Most phase steps.")] = 12,
    shortest_px: Annotated[float, typer.Option("--shortest-px", help="Shortest period, projector px.")] = 12,
    longest_px: Annotated[float, typer.Option("--longest-px", help="Longest period, projector px.")] = 20,
    blur_px: Annotated[float, typer.Option("--blur-px", help="Projector and camera blur, projector px.")] = 1.0,
    free: Annotated[
        bool,
        typer.Option(
            "--free", help="Any frequencies: sees more, but two paths cannot be separated, so not for method mfs."
        ),
    ] = False,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for the table and its figure.")] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Choose frequencies and phase steps for a frame budget, and show what frames buy."""
    from rich.console import Console

    from scanner.design import Demand
    from scanner.folder import DESIGNED_PLAN, PlanFolder
    from scanner.studies.reports import design_study, plan_rows
    from scanner.terminal import plan_table

    demand = Demand(
        size=(width_px, height_px),
        frames=frames,
        from_px=from_px,
        to_px=to_px,
        relative_noise=noise_dn / modulation_dn,
        false_alarm_rate=false_alarm_rate,
        axes=_axes(axes),
        steps=(min_steps, max_steps),
        shortest_px=shortest_px,
        longest_px=longest_px,
        blur_px=blur_px,
        separable=not free,
    )
    if out is None:
        chosen, usual, plans = design_study(demand, None)
    else:
        with PlanFolder(out, overwrite=overwrite) as folder:
            chosen, usual, plans = design_study(demand, folder.path)
            folder.write_json(
                DESIGNED_PLAN,
                {"chosen": plan_rows([chosen])[0], "paper": plan_rows([usual])[0], "trade": plan_rows(plans)},
            )
    console = Console(highlight=False, soft_wrap=True)
    console.print(plan_table(chosen, usual, plans, alpha))
    console.print("\nscan:\n" + chosen.yaml(), markup=False)


@study_app.command("detection")
@interruptible
def study_detection(
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder; default: study-<time>.")] = None,
    seeds: Annotated[int, typer.Option("--seeds", help="Independent pictures of every figure.", min=1)] = 8,
    axes: Annotated[str, typer.Option("--axes", help="x, as the paper's simulation, or x,y.")] = "x",
    fast: Annotated[bool, typer.Option("--small", help="Small pictures: minutes become seconds.")] = False,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Detection at the limit: the paper's α × σ study with three detectors, over all Δu, with intervals."""
    from scanner.folder import DETECTION_STUDY, StudyFolder
    from scanner.studies.reports import detection_study
    from scanner.terminal import Terminal

    terminal = Terminal(quiet)
    with StudyFolder(out or _default_out("study"), overwrite=overwrite) as folder:
        with terminal.working() as report:
            document = detection_study(folder.path, seeds, _axes(axes), fast, report)
        folder.write_json(DETECTION_STUDY, document)
    terminal.detection_study(document, folder.out)


@app.command()
@interruptible
def doctor(
    config: Annotated[
        Path | None, typer.Option("--config", "-c", help="Bench file (YAML): say whether a scan with it could start.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Where the recording would go.")] = Path(),
    as_json: Annotated[bool, typer.Option("--json", help="Print a document for programs.")] = False,
    sets: SetOption = None,
) -> None:
    """Look at machine and devices, say what is missing and what to do; nothing is projected."""
    import json

    from rich.console import Console

    from scanner.config import load_config
    from scanner.doctor.page import show, to_json, worst
    from scanner.doctor.session import run_doctor

    loaded = None if config is None else load_config(config, overrides(sets, None))
    console = Console(highlight=False)
    name = None if config is None else str(config)
    if as_json:
        findings = run_doctor(loaded, out)
        typer.echo(json.dumps(to_json(findings, name), indent=2, ensure_ascii=False))
    else:
        with console.status("…") as status:
            findings = run_doctor(loaded, out, status.update)
        show(console, findings, name)
    if worst(findings) == "fault":
        raise typer.Exit(NOT_READY)


@app.command()
@interruptible
def preview(
    config: ConfigOption,
    pattern: Annotated[
        str, typer.Option("--pattern", "-p", help="What is projected meanwhile: white, grey, black or fringes.")
    ] = "white",
    saturation: Annotated[
        bool, typer.Option("--saturation/--plain", help="Mark saturated pixels red and too dark ones blue.")
    ] = True,
    once: Annotated[bool, typer.Option("--once", help="Print one reading and end.")] = False,
    save: Annotated[Path | None, typer.Option("--save", help="With --once: write the picture to this PNG.")] = None,
    sets: SetOption = None,
) -> None:
    """Show what the camera sees, with saturation and focus, on a screen that is not the projector's."""
    from rich.console import Console

    from scanner.config import load_config
    from scanner.preview.session import run_preview

    loaded = load_config(config, overrides(sets, None))
    console = Console(highlight=False, soft_wrap=True)
    run_preview(loaded, pattern, console, coloured=saturation, once=once, path=save)


@app.command()
@interruptible
def latency(config: ConfigOption, quiet: QuietOption = False, sets: SetOption = None) -> None:
    """Measure how late the projector shows a picture, and keep it with the rig; black and white flash for a minute."""
    from scanner.config import load_config
    from scanner.session import measure_latency
    from scanner.terminal import Terminal

    terminal = Terminal(quiet)
    with terminal.counting("step") as count:
        found, rig = measure_latency(load_config(config, overrides(sets, None)), count)
    terminal.say(
        [
            f"from hand-over to surface: {found.median_s * 1e3:.1f} ms (median), {found.p99_s * 1e3:.1f} ms (p99 of "
            f"{found.samples} steps)",
            f"kept with the rig {rig}"
            if rig is not None
            else f"the file names no rig to keep it with; until it does, write bench.settle_s: {found.p99_s:.3f} plus "
            "one refresh",
        ]
    )


@app.command()
def schema() -> None:
    """Print the JSON schema of configuration files, for editors."""
    import json

    from scanner.config import json_schema

    typer.echo(json.dumps(json_schema(), indent=2, ensure_ascii=False))


def _scan(loaded: LoadedConfig, out: Path, overwrite: bool, terminal: Terminal) -> tuple[ScanResult, Path]:
    """One scan into a result folder; returns the result and where it lies."""
    from scanner.session import run_scan

    return run_scan(loaded, out, overwrite, terminal)


def _known(method: str) -> str:
    """Name of a method; of a Python file the name of the method in it, which the process then knows."""
    if not method.endswith(".py"):
        return method
    from scanner.config import register_file

    return register_file(method)


def _sections(
    source: Path, config: Path | None, method: str, min_modulation: float | None
) -> tuple[ScanSection, GatesSection]:
    """Scan and gates sections: of a configuration, of the take's own, or defaults for images."""
    import json

    from scanner.config import GatesSection, ScanSection, load_config
    from scanner.take import MANIFEST

    changes = {} if min_modulation is None else {"minimum_modulation_dn": min_modulation}
    if config is not None:
        loaded = load_config(config, {f"scan.{k}": v for k, v in changes.items()})
        return loaded.config.scan, loaded.config.gates
    recorded: dict[str, Any] = {}
    if (source / MANIFEST).exists():
        from scanner.take import Take

        recorded = Take.open(source).manifest.get("config") or {}
    scan_document = dict(recorded.get("scan") or {"method": method})
    scan_document.update(changes)
    return (
        ScanSection.model_validate_json(json.dumps(scan_document)),
        GatesSection.model_validate_json(json.dumps(recorded.get("gates") or {})),
    )


def _axes(text: str) -> tuple[Axis, ...]:
    """``x,y`` as axes, each once."""
    names: list[Axis] = [a for a in ("x", "y") if a in [part.strip() for part in text.split(",")]]
    if not names or len(names) != len(text.split(",")):
        raise typer.BadParameter(f"--axes {text}: write x, y or x,y")
    return tuple(names)


def _default_out(stem: str) -> Path:
    from datetime import datetime

    return Path(f"{stem}-{datetime.now():%Y%m%d-%H%M%S}")


def _exit_by_gates(result: ScanResult) -> None:
    from scanner.quality import passed

    if not passed(result):
        raise typer.Exit(GATES_FAILED)


def main() -> None:
    """Entry point of `scan`."""
    run(app)
