"""`libero view`: a scene in the browser."""

import socket

from libero_eval.requests import ViewRequest


def view(request: ViewRequest) -> None:
    """Show a scene in the browser until interrupted; print its address."""
    from libero_eval.viewer import Stage, Viewer

    viewer = Viewer(Stage(request), request.host, request.port)
    try:
        viewer.open(viewer.stage.initial)
        port = viewer.port
        print(f"showing {request.what} at http://localhost:{port}", flush=True)
        print(f"from another machine: ssh -L {port}:localhost:{port} {socket.gethostname()}", flush=True)
        viewer.run()
    finally:
        viewer.close()
