# The same flow on another engine: reads build/<agent>/plan/dag.json, which `pipeline/plan.py` writes.
#   snakemake --cores 2 --config agent=cat            (profile: profiles/local)
import json
import subprocess
import sys
from pathlib import Path

HOME = config.get("agent", "cat")
if config.get("variant"):
    HOME += f"/variants/{config['variant']}"
subprocess.run([sys.executable, "-SE", "-m", "pipeline.plan", "plan", HOME], check=True, stdout=sys.stderr)
JOBS = json.loads(Path("build", HOME, "plan", "dag.json").read_text())


rule all:
    input: [job["stamp"] for job in JOBS if not job["aside"]]
    localrule: True


for job in JOBS:
    rule:
        name: job["id"].replace(".", "_")
        input: [f"{each['path']}/.ok" for each in job["inputs"]], job["keys"]
        output: job["stamp"]
        threads: job["threads"]
        resources: mem_mb=job["memory_mb"], gpu=job["gpu"] if config.get("gpu") else 0
        retries: 1 if job["resumable"] else 0
        params: home=HOME, id=job["id"], python=sys.executable
        shell: "{params.python} -SE -m pipeline.run {params.home} {params.id}"
