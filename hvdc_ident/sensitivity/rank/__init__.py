"""How structural identifiability is decided: series over exact numbers, random points, ranks, and words for what is seen."""
