from .plus import PlusVariant, camera_pose, joint_pose, parse_plus_id
from .suites import PublishedTask, published_sizes, published_suite, require_available

__all__ = [
    "PlusVariant",
    "PublishedTask",
    "camera_pose",
    "joint_pose",
    "parse_plus_id",
    "published_sizes",
    "published_suite",
    "require_available",
]
