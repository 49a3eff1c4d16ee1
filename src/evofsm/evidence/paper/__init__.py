"""The paper's Section 3: 80 runs of car following, and every claim beside what was measured."""
