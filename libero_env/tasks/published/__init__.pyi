from .plus_id import PlusVariant as PlusVariant
from .plus_id import parse_plus_id as parse_plus_id
from .plus_values import camera_pose as camera_pose
from .plus_values import joint_pose as joint_pose

__all__ = ["PlusVariant", "camera_pose", "joint_pose", "parse_plus_id"]
