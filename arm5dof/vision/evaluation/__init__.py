"""How good detection and localization are, on scenes never seen."""
