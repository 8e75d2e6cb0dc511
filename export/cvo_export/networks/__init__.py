"""Networks: backbones, the methods' heads, baselines and losses."""
