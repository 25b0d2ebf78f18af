"""`libero demos generate`, for a run of `libero train` too."""

from dataclasses import replace

from libero_env.cli import recording
from libero_env.cli.recording import RecordingRequest


def generate(request: RecordingRequest) -> int:
    """Record what is missing, then list the files and the failures; return 1 if a task is not complete."""
    return recording.generate(resolved(request))


def resolved(request: RecordingRequest) -> RecordingRequest:
    """Return a request with what the run asks for that it names, as far as it asks for nothing else itself."""
    if not request.training:
        return request
    from lifelong.cli.runs import data_settings

    data = data_settings(request.training)
    return replace(
        request,
        size=request.size or (None if request.no_images else (data.image_size, data.image_size)),
        drawing=request.drawing or (None if request.no_images else data.drawing),
        robot=request.robot or data.robot,
        seed=data.seed if request.seed is None else request.seed,
    )
