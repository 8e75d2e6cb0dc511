"""Networks: backbones, heads of the methods, baselines and losses."""
