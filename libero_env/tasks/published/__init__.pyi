from .folders import is_published
from .plus_id import PlusVariant, parse_plus_id
from .plus_values import camera_pose, joint_pose
from .suites import published_sizes, published_suite
from .task import PublishedTask, require_available

__all__ = [
    "PlusVariant",
    "PublishedTask",
    "camera_pose",
    "is_published",
    "joint_pose",
    "parse_plus_id",
    "published_sizes",
    "published_suite",
    "require_available",
]
