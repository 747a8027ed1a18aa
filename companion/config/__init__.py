"""Configuration: schema, loading, validation, output profiles."""

from companion.config.load import PREFIX, ConfigError, load, parse, to_toml
from companion.config.schema import (
    AirDataConfig,
    Channel,
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
    SigningConfig,
    StrapdownConfig,
)

__all__ = [
    "PREFIX",
    "AirDataConfig",
    "Channel",
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
    "SigningConfig",
    "StrapdownConfig",
    "load",
    "parse",
    "to_toml",
]
