"""What other projects read, write and serve: their data sets, results, policies and servers, and a viewer."""

from libero_env import __distribution__ as __distribution__
