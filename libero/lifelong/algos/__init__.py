"""The original's lifelong-learning algorithms."""

from libero.lifelong.algos.agem import AGEM
from libero.lifelong.algos.base import REGISTERED_ALGOS, Sequential, get_algo_class, get_algo_list
from libero.lifelong.algos.er import ER
from libero.lifelong.algos.ewc import EWC
from libero.lifelong.algos.multitask import Multitask
from libero.lifelong.algos.packnet import PackNet
from libero.lifelong.algos.single_task import SingleTask
