"""The balance of forces, a sum of terms, and what the terms are made of."""
