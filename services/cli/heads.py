"""The commands under ``kouxing head``, and the GLB files of the heads that the page shows.

The package contains only its own head files (.npz), because GLB files are five times as large. A
source tree and the container image have the GLB files in the page's folder. Otherwise
``kouxing run`` exports them once, to the user's cache folder.
"""

from importlib import resources
from pathlib import Path
from typing import Annotated

import typer

from kouxing.services.cli.options import HeadName
from kouxing.services.heads import DEFAULT_HEAD, HEAD_NAMES, page_file, page_heads_folder
from kouxing.shared.command.terminal import Force, check_output, print_message
from kouxing.shared.errors import UserError
from kouxing.shared.files.output_file import create_folder

_DRIVER_HEADS = Path(str(resources.files("kouxing.services.driver"))) / "head"
_PAGE = Path(str(resources.files("kouxing.services.gateway"))) / "page"

app = typer.Typer(no_args_is_help=True, help="Export and import 3-D heads.")


@app.command("export")
def export_head(
    glb: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="File to write: .glb, or .vrm for an avatar. For all heads: an existing folder.",
        ),
    ],
    head: HeadName = DEFAULT_HEAD,
    force: Force = False,
) -> None:
    """Write a head for a game engine: a GLB with FAPs and ARKit shapes, or a VRM 1.0 avatar."""
    from kouxing.services.driver.head.glb_export import export_glb
    from kouxing.services.driver.render.scene import load_head

    if glb.is_dir():
        if head != DEFAULT_HEAD:
            raise UserError(f"{glb} is a folder for all heads; leave out --head, or name a file")
        check_output(*(glb / page_file(name) for name in HEAD_NAMES), force=force)
        export_page_heads(glb)
        print_message(f"wrote the heads to {glb}")
        return
    check_output(glb, inputs=[Path(head)], force=force)
    export_glb(load_head(head), glb)
    print_message(f"wrote {glb} ({glb.stat().st_size / 1e6:.1f} MB)")


@app.command("import")
def import_mesh(
    mesh: Annotated[Path, typer.Argument(help="Mesh of a head at rest (.obj, .glb or .ply).")],
    points: Annotated[
        Path,
        typer.Option(
            help="MPEG-4 feature points: a file of lines 'point x y z' or 'point vertex' (counted"
            " from 0), or an XfaceEd .fdp file."
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Head to write (.npz).")],
    force: Force = False,
) -> None:
    """Convert a mesh to a head that FAPs can move, for the option --head."""
    from kouxing.services.driver.head.import_head import import_head

    check_output(output, inputs=[mesh, points], force=force)
    for warning in import_head(mesh, points, output):
        print_message(warning)
    print_message(f"wrote {output} ({output.stat().st_size / 1e6:.1f} MB)")


def export_page_heads(folder: Path) -> None:
    """Export all heads of the package; raise ``UserError`` if a file cannot be written."""
    from kouxing.services.driver.head.glb_export import export_glb
    from kouxing.services.driver.render.scene import load_head

    create_folder(folder)
    for name in HEAD_NAMES:
        export_glb(load_head(name), folder / page_file(name))


def ensure_page_heads() -> None:
    """Export the heads to the cache folder, unless they are up to date or in the page's folder."""
    if _has_current_heads(_PAGE):
        return
    try:
        folder = page_heads_folder()
        if not _has_current_heads(folder):
            export_page_heads(folder)
    except UserError as error:
        print_message(f"the page has no heads: {error}")


def _has_current_heads(folder: Path) -> bool:
    """Return whether a folder has all heads, newer than what they are made from."""
    files = [folder / page_file(name) for name in HEAD_NAMES]
    if not all(file.is_file() for file in files):
        return False
    sources = [
        *(_DRIVER_HEADS / "assets").iterdir(),
        *_DRIVER_HEADS.glob("*.py"),
        _DRIVER_HEADS.parent / "render" / "shaders.py",
    ]
    newest_source_s = max(source.stat().st_mtime for source in sources)
    return min(file.stat().st_mtime for file in files) > newest_source_s
