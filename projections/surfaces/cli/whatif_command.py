"""`mapfold whatif`: the map under other settings or without a command."""

from pathlib import Path
from typing import Annotated

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import counted, shorten_by
from eventsrc.log import LogReader
from projections.fold.corrections import NO_CORRECTIONS, Corrections, compile_corrections
from projections.fold.settings import Settings
from projections.history.diff_rendering import whatif_text
from projections.history.rule_folds import Rules
from projections.history.whatif import (
    Alternative,
    WhatIf,
    alternatives,
    assigned,
    command_trials,
    setting_trials,
    what_if,
)
from projections.localize.evaluate.truth import read_truth
from projections.map.parsing import read_commands

from . import folded_log
from .options import JsonOption, check_picture, option
from .terminal import Bar, display, emit, say


def whatif(
    log: folded_log.LogArgument,
    *,
    named: folded_log.NamedSettings,
    set_: Annotated[
        list[str] | None,
        option(
            "NAME=VALUE",
            "Change a setting; all --set make one alternative, and hold for all of a --grid.",
            "--set",
        ),
    ] = None,
    try_: Annotated[
        list[str] | None, option("'NAME=VALUE …'", "One alternative; may be repeated.", "--try")
    ] = None,
    grid: Annotated[
        list[str] | None,
        option(
            "NAME=VALUE,…",
            "An alternative for every combination of these values and those of other --grid.",
            "--grid",
        ),
    ] = None,
    base: Annotated[
        str,
        option("'NAME=VALUE …'", "Settings of the base map, on top of --settings or the log's."),
    ] = "",
    without: Annotated[
        list[str] | None,
        option(
            "COMMAND_ID",
            "One alternative: the map without this command; may be repeated.",
            "--without",
        ),
    ] = None,
    at: folded_log.AtOption = "end",
    known_at: folded_log.KnownAtOption = None,
    truth: Annotated[
        list[Path] | None,
        option("FILE", "Score places and objects against this ground truth.", "--truth"),
    ] = None,
    json_: JsonOption = False,
    all_: folded_log.AllOption = False,
    picture: Annotated[
        Path | None, option("FILE", "Draw the maps side by side (.png, .svg, .pdf).", "--picture")
    ] = None,
    processes: Annotated[
        int | None,
        option("N", "Fold in this many processes [default: the number of cores].", min=1),
    ] = None,
    settings_file: folded_log.SettingsOption = None,
) -> None:
    """Show the map under other settings, or without one of its commands.

    Places, noise, merges and objects under each, and how the maps differ. ARI is the adjusted Rand
    index against the base: 1 is the same partition of keyframes into places or observations into
    objects, 0 no better than chance, and so is any difference from a base of one single place. With
    --truth, V is the V-measure against rooms and instances: 1 is perfect.
    """

    logged = folded_log.FoldSettings(settings_file=settings_file).checked()

    def settings(corrections: Corrections) -> Settings:
        return assigned(logged(corrections), base, "--base")

    def others(settings: Settings) -> list[Settings]:
        return alternatives(settings, named.around(set_), try_ or (), grid or ())

    tried = others(settings(NO_CORRECTIONS))  # a bad value is an error before the log is opened
    check_picture(picture)
    if not tried and not without:
        raise MisuseError(
            "nothing to try; give --set eps_m=1.0, --try, --grid eps_m=0.5,1.0 or"
            " --without COMMAND_ID"
        )
    scored = read_truth(truth) if truth else None
    with LogReader(log) as reader:
        end = folded_log.point(reader, at)
        commands = read_commands(reader, folded_log.known_point(reader, known_at, end))
    corrections = compile_corrections(commands)
    common = Rules(settings(corrections), corrections)
    trials = setting_trials(common, others(common.settings))
    trials += command_trials(commands, without or (), settings)
    with Bar() as bar:
        found = what_if(
            log, common, trials, end,
            truth=scored, processes=processes, progress=bar.show_fold,
            keep_views=picture is not None,
        )  # fmt: skip
    folded_log.warn_of_no_truth(log, found.base.result.scores)
    if picture is not None:
        _draw_maps(found, picture)
    if json_:
        emit(found.document())
    else:
        shorten_by(found.short_ids().text)
        display(whatif_text(found, most=None if all_ else folded_log.MOST_LINES))


def _draw_maps(found: WhatIf, out: Path) -> None:
    # Here and not above: matplotlib takes longer to import than most commands take to run.
    from projections.adapters.drawing.merge_picture import draw_maps

    maps = [(_title(each), each.result.view) for each in found.all]
    draw_maps([(title, view) for title, view in maps if view is not None], out)
    say(f"wrote {out}: {counted(len(maps), 'map')}")


def _title(each: Alternative) -> str:
    counts = each.result.counts
    return f"{each.name}: {counted(counts['places'], 'place')}, {counts['noise']} noise"
