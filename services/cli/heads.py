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
        Path,
        typer.Argument(
            metavar="FILE",
            help="File to write: .glb, or .vrm for an avatar. With --all, a folder.",
        ),
    ],
    head: HeadName = DEFAULT_HEAD,
    all_heads: Annotated[
        bool, typer.Option("--all", help="Export all heads of the package for the page.")
    ] = False,
) -> None:
    """Write a head for an engine: a GLB with FAPs and ARKit shapes, or a VRM 1.0 avatar."""
    from kouxing.services.cli.page_heads import export_page_heads
    from kouxing.services.driver.head.glb_export import export_glb
    from kouxing.services.driver.render.scene import load_head

    if all_heads:
        export_page_heads(glb)
        print_message(f"wrote the heads to {glb}")
        return
    export_glb(load_head(head), glb)
    print_message(f"wrote {glb} ({glb.stat().st_size / 1e6:.1f} MB)")


@app.command("import")
def import_mesh(
    mesh: Annotated[Path, typer.Argument(help="Mesh of a head at rest (.obj, .glb or .ply).")],
    points: Annotated[
        Path,
        typer.Option(
            help="MPEG-4 feature points: a file with lines 'point x y z' or 'point vertex' (the"
            " first vertex is 0), or an XfaceEd .fdp file."
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Head to write (.npz).")],
) -> None:
    """Convert a mesh to a head that FAPs can move. Use it with --head."""
    from kouxing.services.driver.head.import_head import import_head

    for remark in import_head(mesh, points, output):
        print_message(remark)
    print_message(f"wrote {output} ({output.stat().st_size / 1e6:.1f} MB)")
