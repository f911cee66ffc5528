"""The commands under ``kouxing head``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kouxing.services.cli.options import DEFAULT_HEAD, HeadName
from kouxing.shared.terminal import print_message

app = typer.Typer(no_args_is_help=True, help="The 3-D heads.")


@app.command("export")
def export_head(
    glb: Annotated[
        Path, typer.Argument(metavar="FILE", help="File to write: .glb, or .vrm for an avatar.")
    ],
    head: HeadName = DEFAULT_HEAD,
) -> None:
    """Write a head for an engine: a GLB of FAPs and ARKit shapes, or a VRM 1.0 avatar."""
    from kouxing.services.driver.head.glb_export import export_glb
    from kouxing.services.driver.render.scene import load_head

    export_glb(load_head(head), glb)
    print_message(f"wrote {glb} ({glb.stat().st_size / 1e6:.1f} MB)")


@app.command("import")
def import_mesh(
    mesh: Annotated[Path, typer.Argument(help="Mesh of a head at rest (.obj, .glb, .ply).")],
    points: Annotated[
        Path,
        typer.Option(
            help="MPEG-4 feature points: lines 'point x y z' or 'point vertex' (from 0), or an"
            " XfaceEd .fdp file."
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Head to write (.npz).")],
) -> None:
    """Turn a mesh into a head that FAPs move; use it with --head."""
    from kouxing.services.driver.head.import_head import import_head

    for remark in import_head(mesh, points, output):
        print_message(remark)
    print_message(f"wrote {output} ({output.stat().st_size / 1e6:.1f} MB)")
