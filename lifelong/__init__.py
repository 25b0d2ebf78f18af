"""Lifelong robot learning: data, policies, algorithms, training, evaluation and reports."""
