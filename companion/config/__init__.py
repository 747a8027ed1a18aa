"""Configuration: schema, loading, validation and output profiles.

schema      one frozen structure per section of the TOML file, the unit in every key
load        file, environment and command line merged; `ConfigError` for every mistake
validate    combinations of keys that are invalid
profiles    table of output profiles: messages, rates and autopilot parameters per make of autopilot
required_parameters     autopilot parameters that a configuration requires
"""

from companion.config.load import PREFIX, ConfigError, load, parse, to_toml
from companion.config.schema import (
    AirDataConfig,
    Config,
    EstimatorConfig,
    GnssConfig,
    InertialConfig,
    IntegrityConfig,
    LinkConfig,
    LogConfig,
    OutputConfig,
    PredictorConfig,
    RatesConfig,
    RsbnConfig,
    Sensor,
    SigningConfig,
    StrapdownConfig,
)

__all__ = [
    "PREFIX",
    "AirDataConfig",
    "Config",
    "ConfigError",
    "EstimatorConfig",
    "GnssConfig",
    "InertialConfig",
    "IntegrityConfig",
    "LinkConfig",
    "LogConfig",
    "OutputConfig",
    "PredictorConfig",
    "RatesConfig",
    "RsbnConfig",
    "Sensor",
    "SigningConfig",
    "StrapdownConfig",
    "load",
    "parse",
    "to_toml",
]
