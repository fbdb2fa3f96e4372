"""The command line: `scan`, and `process`, `compare`, `doctor`, `preview`, `latency` and `schema` below it.

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
    from scanner.result import ScanResult
    from scanner.terminal import Terminal

app = new_app()

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
    scans = plan_scans(lambda more: load_config(config, {**changes, **more}), section.methods, section.seeds)
    known = None if reuse is None else read_result(reuse)
    command = ["scan", "compare", "--config", str(config), "--methods", methods or ",".join(section.methods)]
    command += ["--seeds", str(section.seeds), *(word for s in sets or [] for word in ("--set", s))]
    command += ["--fit", fit] if fit is not None else []
    with ComparisonFolder(out or _default_out("comparison"), overwrite=overwrite) as folder:

        def scan(planned: Planned) -> ScanResult:
            if known is not None and planned.number == 0 and planned.method == known.method:
                return known
            terminal.say([f"{planned.method}, scan {planned.number + 1} of {section.seeds}"])
            return _scan(planned.loaded, folder.path / planned.folder, False, terminal)[0]

        rows = run_comparison(scans, scan, section, folder, command)
    terminal.comparison(rows, folder.out)


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
    with terminal.working() as report:
        found, rig = measure_latency(
            load_config(config, overrides(sets, None)), lambda done, total: report(f"step {done} of {total}")
        )
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
