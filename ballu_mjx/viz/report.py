"""Report of a run as one page for the browser: `python -m ballu_mjx report RUN`.

The page has options, learning curves, errors, plots over time, and the replay in 3D. It contains all its data and loads
nothing. JAX, MuJoCo and modules that need them are imported inside functions: `runtime.prepare` has to come first.
"""

from __future__ import annotations

import base64
import dataclasses
import importlib.resources
import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from ballu_mjx.common.errors import InputError
from ballu_mjx.runs.rollout_file import StoredRollout
from ballu_mjx.viz.report_content import Content, Curve

REPORT_FILE = "report.html"
_TEMPLATE = "report.html"
_FORCE_COLOURS = ("#cc0000", "#7b3294", "#998ec3")
_ROW_HEIGHT = 170


def render(content: Content) -> str:
    """Return the page as HTML. All strings of the run are escaped, so that none is read as markup.

    **Raises** `InputError` if packages of the extra `report` are missing.
    """
    try:
        import jinja2
        import markdown_it
        import markupsafe
        from plotly.offline import get_plotlyjs

        from ballu_mjx.viz import robot_meshes, viser_scene
        from ballu_mjx.viz.style import label_of, step_axis
    except ImportError as error:
        raise InputError(
            f"The report needs {error.name}, which comes with the extra report: pip install -c constraints.txt -e "
            '".[report]".'
        ) from None
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    template = environment.from_string(
        importlib.resources.files("ballu_mjx.viz").joinpath(_TEMPLATE).read_text(encoding="utf-8")
    )
    markdown = markdown_it.MarkdownIt("commonmark", {"html": False}).enable("table")
    takes = [dataclasses.replace(take, time=take.time - take.time[0]) for take in content.takes]
    head, own, tail = viser_scene.shared([viser_scene.page(take) for take in takes]) if takes else ("", [], "")
    pushed = {take.description.sha256: take.description for take in takes if robot_meshes.pushed_robot(take)}
    arrows = [robot_meshes.RobotShapes(robot).arrow_scale for robot in pushed.values()]
    shown = {
        "curves": [_plot(_curve_rows([curve]), step_axis(curve.steps)[0]) for curve in content.curves],
        "takes": [_plot(_take_rows(take), "time (s)") for take in takes],
        "stage": {"head": head, "own": own, "tail": tail},
    }
    return template.render(
        content=content,
        markdown=[(title, markupsafe.Markup(markdown.render(text))) for title, text in content.markdown],
        images=[(title, base64.b64encode(png).decode()) for title, png in content.images],
        legends=[[(label_of(name), _hex(name)) for name in take.qpos] for take in takes],
        arrows=arrows,
        shown=shown,
        plotly=markupsafe.Markup(get_plotlyjs()),
    )


@dataclasses.dataclass(frozen=True)
class _Line:
    name: str
    colour: str
    x: np.ndarray
    y: np.ndarray
    dash: str = "solid"


_Rows = Sequence[tuple[str, Sequence[_Line]]]


def _hex(name: str) -> str:
    from matplotlib.colors import to_hex

    from ballu_mjx.viz.style import colour_of

    return to_hex(colour_of(name))


def _curve_rows(curves: Sequence[Curve]) -> _Rows:
    from ballu_mjx.viz.style import label_of, step_axis

    rows = []
    for each in curves:
        _, one = step_axis(each.steps)
        lines = [_Line(label_of(name), _hex(name), steps / one, y) for name, (steps, y) in each.values.items()]
        rows.append((each.title, lines))
    return rows


def _take_rows(take: StoredRollout) -> _Rows:
    """Return plot rows over time: x, y and yaw of each robot's tracked body, the residual force, and the commands."""
    from ballu_mjx.viz import robot_meshes
    from ballu_mjx.viz.style import COMMAND_COLOURS, label_of, unwrapped

    robot = take.description
    model = robot.load_model()
    poses = {name: robot_meshes.poses(model, robot, qpos) for name, qpos in take.qpos.items()}
    start = next(iter(poses.values())).yaw[0]
    ways = {name: unwrapped(np.column_stack([p.tracked[:, :2], p.yaw])[None], start)[0] for name, p in poses.items()}
    rows: list[tuple[str, Sequence[_Line]]] = [
        (title, [_Line(label_of(name), _hex(name), take.time, way[:, i]) for name, way in ways.items()])
        for i, title in enumerate(("x (m)", "y (m)", "yaw (deg)"))
    ]
    steps = take.time[:-1]
    if take.force is not None:
        forces = zip("xyz", _FORCE_COLOURS, take.force.T, strict=True)
        rows.append(("residual force (N)", [_Line(f"force {axis}", c, steps, value) for axis, c, value in forces]))
    if take.command is not None:
        commands = []
        for index, name in enumerate(robot.commands):
            colour, dash = COMMAND_COLOURS[index % len(COMMAND_COLOURS)], ("solid", "dot")[index % 2]
            commands.append(_Line(f"command, {name}", colour, steps, take.command[:, index], dash))
        rows.append(("command", commands))
    return rows


def _plot(rows: _Rows, x_title: str) -> dict[str, Any]:
    """Return a Plotly figure as plain data, with a panel for each row and a shared x axis."""
    from plotly.subplots import make_subplots

    figure = make_subplots(rows=len(rows), cols=1, shared_xaxes=True, vertical_spacing=0.03)
    named: set[str] = set()
    for index, (title, lines) in enumerate(rows, start=1):
        for line in lines:
            figure.add_scatter(
                x=np.asarray(line.x, np.float32),
                y=np.asarray(line.y, np.float32),
                name=line.name,
                legendgroup=line.name,
                showlegend=line.name not in named,
                mode="lines" if len(line.x) > 1 else "markers",
                line={"color": line.colour, "width": 1.5, "dash": line.dash},
                row=index,
                col=1,
            )
            named.add(line.name)
        figure.update_yaxes(title_text=title, row=index, col=1)
    figure.update_xaxes(title_text=x_title, row=len(rows), col=1)
    figure.update_layout(
        height=_ROW_HEIGHT * len(rows) + 110,
        margin={"l": 70, "r": 20, "t": 20, "b": 50},
        template="plotly_white",
        hovermode="x unified",
        legend={"orientation": "h", "y": 1.0, "yanchor": "bottom"},
    )
    return json.loads(str(figure.to_json()))
