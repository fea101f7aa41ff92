"""How many damaged inputs are tried: a few in every run of the suite, thousands with `--hypothesis-profile long`."""

from hypothesis import HealthCheck, settings

ALWAYS = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture]

settings.register_profile(
    "short", max_examples=25, deadline=None, derandomize=True, database=None, suppress_health_check=ALWAYS
)
settings.register_profile("long", max_examples=5000, deadline=None, database=None, suppress_health_check=ALWAYS)
if settings.get_current_profile_name() != "long":
    settings.load_profile("short")
