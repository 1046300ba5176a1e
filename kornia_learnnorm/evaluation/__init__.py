"""Using and measuring estimates: image pairs, predictions, tables and figures."""
