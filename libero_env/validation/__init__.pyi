from .messages import Key, LineOf
from .values import OneOf, Parameters, accepted, is_plain, parameters_of, validate, validate_arguments
from .yaml_files import MAX_YAML_BYTES, YamlFile, parse_yaml_text, read_yaml_file

__all__ = [
    "MAX_YAML_BYTES",
    "Key",
    "LineOf",
    "OneOf",
    "Parameters",
    "YamlFile",
    "accepted",
    "is_plain",
    "parameters_of",
    "parse_yaml_text",
    "read_yaml_file",
    "validate",
    "validate_arguments",
]
