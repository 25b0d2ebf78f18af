from .agem import AGEM
from .base import Algorithm, Phase
from .compressed_er import CompressedER
from .contrib.averaging import Averaging
from .contrib.clare import CLARE
from .contrib.dmpel import DMPEL
from .contrib.m2distill import M2Distill
from .contrib.mlr import MLR
from .contrib.omla import OMLA
from .contrib.slca import SLCA
from .derpp import DERpp
from .er import ER
from .ewc import EWC
from .iscil import IsCiL
from .lora import LoRA
from .lwf import LwF
from .mas import MAS
from .mir import MIR
from .multitask import Multitask
from .packnet import PackNet
from .sequential import Sequential
from .si import SI
from .single_task import SingleTask

__all__ = [
    "AGEM",
    "CLARE",
    "DMPEL",
    "ER",
    "EWC",
    "MAS",
    "MIR",
    "MLR",
    "OMLA",
    "SI",
    "SLCA",
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
