"""`intercap annotate`: a server on the loopback address."""

from __future__ import annotations

import atexit
import secrets
import shutil
import socket
import tempfile
import webbrowser
from pathlib import Path

import typer

from intercap_core.errors import UserError

HOST = "127.0.0.1"


def serve(
    settings: Path,
    sequence: str | None,
    *,
    port: int,
    by: str,
    cores: int,
    profile: Path | None,
    show: bool,
) -> None:
    """Serve the page until the process is interrupted; arguments as of `intercap annotate`.

    Raises UserError if the project has a fault, the port is in use or a library is missing.
    """
    try:
        import uvicorn

        from intercap_core.annotate.annotator import Annotator
        from intercap_core.annotate.server import LimitedProtocol, application
    except ModuleNotFoundError as error:
        raise UserError(
            f"the page needs the package {error.name}: pip install 'intercap-core[annotate]'"
        ) from None
    annotator = Annotator(settings, by=by, cores=cores, profile=profile)
    if sequence is not None:
        annotator.project.require_sequence(sequence)
    token = secrets.token_urlsafe(24)
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind((HOST, port))
            listening.listen()  # requests wait from now on, before the address is printed
        except OSError as error:
            raise UserError(
                f"port {port} cannot be used ({error.strerror}); name another one by --port"
            ) from None
        used = listening.getsockname()[1]
        where = f"/sequence/{sequence}" if sequence else "/"
        address = f"http://{HOST}:{used}{where}#token={token}"
        typer.echo(f"open {address}")
        tunnel = f"ssh -L {used}:{HOST}:{used} {socket.gethostname()}"
        typer.echo(f"from another machine: {tunnel}, then the same address")
        typer.echo("anyone who has this address can change annotations; Ctrl+C ends the server")
        if show:
            _show(address)
        options = uvicorn.Config(
            application(annotator, token), log_level="error", access_log=False,
            server_header=False, timeout_graceful_shutdown=2, ws="none", http=LimitedProtocol,
        )  # fmt: skip
        try:
            uvicorn.Server(options).run(sockets=[listening])
        finally:
            annotator.runs.stop()
            if annotator.runs.in_progress:
                typer.echo(
                    f"the run of {annotator.runs.sequence} is ending; finished results are kept"
                )
                annotator.runs.wait()


def _show(address: str) -> None:
    """Open the default browser with a file that only this user can read.

    The address contains the token, and other users can see the arguments of programs.
    """
    folder = Path(tempfile.mkdtemp(prefix="intercap-annotate-"))  # readable by this user only
    page = folder / "open.html"
    page.write_text(f'<meta http-equiv="refresh" content="0;url={address}">', encoding="utf-8")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    webbrowser.open(page.as_uri())
