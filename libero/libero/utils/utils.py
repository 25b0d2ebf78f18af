"""Functions for stored models and pictures."""

import os
from collections.abc import Mapping
from typing import Any
from xml.etree import ElementTree

import numpy as np

from libero._adapters.models import assets_folder
from libero_env.assets.robot import robot_file
from libero_env.objects.xml_file import parse_xml_text

DIR = os.path.dirname(__file__)
_ROBOSUITE, _ASSETS = "robosuite/models/assets/", "/assets/"


def postprocess_model_xml(xml_str: str, cameras_dict: Mapping[str, Mapping[str, Any]] | None = None) -> str:
    """Return a stored model with the paths of this machine, and with new attributes of cameras by name, then fixed."""
    root = parse_xml_text(xml_str.encode(), "the stored model")
    for element in root.iterfind("asset/*[@file]"):
        file = element.get("file", "")
        if _ROBOSUITE in file:
            element.set("file", str(robot_file(file.split(_ROBOSUITE)[-1])))
        elif _ASSETS in file and (folder := assets_folder()):
            element.set("file", str(folder / file.split(_ASSETS)[-1]))
    for camera in root.iter("camera"):
        given = (cameras_dict or {}).get(camera.get("name", ""))
        for key, value in {"mode": "fixed", **given}.items() if given else ():
            camera.set(key, value if isinstance(value, str) else " ".join(map(str, np.atleast_1d(value))))
    return ElementTree.tostring(root, encoding="unicode")


def process_image_input(img_tensor: np.ndarray) -> np.ndarray:
    """Return pixels in [0, 1] of pixels in [0, 255]."""
    return img_tensor / 255.0


def reconstruct_image_output(img_array: np.ndarray) -> np.ndarray:
    """Return pixels in [0, 255] of pixels in [0, 1]."""
    return img_array * 255.0


def update_env_kwargs(env_kwargs: dict[str, Any], **kwargs: Any) -> None:
    """Update arguments of an environment in place."""
    env_kwargs.update(kwargs)
