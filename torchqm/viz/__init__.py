"""Pictures of shapes, maps, symmetries and errors, on matplotlib alone (imported when a picture is drawn)."""

from torchqm.viz.camera import View, auto_frame, project
from torchqm.viz.charts import bar_figure, curve_points, error_curves, line_figure
from torchqm.viz.plots import match_figure, scalar_figure, symmetry_figure
from torchqm.viz.render import render_mesh, to_rgb, xyz_colors

__all__ = [
    "View",
    "auto_frame",
    "bar_figure",
    "curve_points",
    "error_curves",
    "line_figure",
    "match_figure",
    "project",
    "render_mesh",
    "scalar_figure",
    "symmetry_figure",
    "to_rgb",
    "xyz_colors",
]
