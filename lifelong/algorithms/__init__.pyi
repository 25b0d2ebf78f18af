from .agem import AGEM
from .averaging import Averaging
from .base import Algorithm, Phase
from .clare import CLARE
from .compressed_er import CompressedER
from .derpp import DERpp
from .dmpel import DMPEL
from .er import ER
from .ewc import EWC
from .iscil import IsCiL
from .lora import LoRA
from .lwf import LwF
from .m2distill import M2Distill
from .mas import MAS
from .mir import MIR
from .mlr import MLR
from .multitask import Multitask
from .omla import OMLA
from .packnet import PackNet
from .sequential import Sequential
from .si import SI
from .single_task import SingleTask
from .slca import SLCA

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
