"""A layout for Foxglove: the map from above, counts of Places and Objects, what changed."""

from typing import Final

from foxglove import layouts

from .scene import FRAME

_SERIES: Final = (("places", "#3b82c4"), ("objects", "#e08a1e"), ("noise", "#8b939c"))


def layout_json() -> str:
    """The layout as JSON, for "Import from file" in Foxglove's menu of layouts."""
    seen_from_above = layouts.ThreeDeeConfig(
        fixed_frame=FRAME,
        follow_mode="follow-none",
        camera_state=layouts.ThreeDeeCameraState(perspective=False, phi=0.0, distance=25.0),
        topics={
            "/mapfold/map": layouts.BaseRendererSceneUpdateTopicSettings(visible=True),
            "/mapfold/walls": layouts.BaseRendererGridTopicSettings(visible=True),
        },
    )
    counts = layouts.PlotConfig(
        paths=[
            layouts.PlotSeries(
                value=f"/mapfold/state.{name}",
                label=name,
                color=colour,
                enabled=True,
                line_interpolation="step",
            )
            for name, colour in _SERIES
        ],
        show_legend=True,
    )
    changes = layouts.LogConfig(topic_to_render="/mapfold/changes")
    beside = layouts.SplitContainer(
        direction="column",
        items=[
            layouts.SplitItem(content=layouts.PlotPanel(config=counts, title="Counts")),
            layouts.SplitItem(content=layouts.LogPanel(config=changes, title="Changes")),
        ],
    )
    whole = layouts.SplitContainer(
        direction="row",
        items=[
            layouts.SplitItem(
                proportion=2, content=layouts.ThreeDeePanel(config=seen_from_above, title="Map")
            ),
            layouts.SplitItem(proportion=1, content=beside),
        ],
    )
    return layouts.Layout(content=whole).to_json() + "\n"
