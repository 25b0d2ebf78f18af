"""Lifelong-learning algorithms: what each adds to the one training loop, one class per file."""

from lifelong.algorithms.agem import AGEM
from lifelong.algorithms.averaging import Averaging
from lifelong.algorithms.base import Algorithm, Phase
from lifelong.algorithms.clare import CLARE
from lifelong.algorithms.compressed_er import CompressedER
from lifelong.algorithms.derpp import DERpp
from lifelong.algorithms.dmpel import DMPEL
from lifelong.algorithms.er import ER
from lifelong.algorithms.ewc import EWC
from lifelong.algorithms.iscil import IsCiL
from lifelong.algorithms.lora import LoRA
from lifelong.algorithms.lwf import LwF
from lifelong.algorithms.m2distill import M2Distill
from lifelong.algorithms.mas import MAS
from lifelong.algorithms.mlr import MLR
from lifelong.algorithms.multitask import Multitask
from lifelong.algorithms.omla import OMLA
from lifelong.algorithms.packnet import PackNet
from lifelong.algorithms.sequential import Sequential
from lifelong.algorithms.si import SI
from lifelong.algorithms.single_task import SingleTask

__all__ = [
    "AGEM",
    "CLARE",
    "DMPEL",
    "ER",
    "EWC",
    "MAS",
    "MLR",
    "OMLA",
    "SI",
    "Algorithm",
    "Averaging",
    "CompressedER",
    "DERpp",
    "IsCiL",
    "LoRA",
    "LwF",
    "M2Distill",
    "Multitask",
    "PackNet",
    "Phase",
    "Sequential",
    "SingleTask",
]
