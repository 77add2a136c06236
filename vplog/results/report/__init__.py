"""The values of report.html; `results/templates/report.html` lays them out."""
