# The same flow on another engine, one rule per artifact. What there is to do, pipeline/workflow/plan.py writes to
# build/<agent>/plan/dag.json, one job per line; an artifact is published by pipeline/workflow/run.py.
#   snakemake --cores 2 --config agent=cat                       (profile: profiles/default)
#   snakemake --config agents=[luna,cat] --workflow-profile profiles/slurm
#   snakemake --config homes=homes.tsv --workflow-profile profiles/slurm  (a table with the columns agent and, if needed, variant)
# More configuration: variant=NAME, gpu=N (GPUs of a job that uses one), processes=N (per machine, where several fit one
# model), launcher="srun --ntasks-per-node=1" (starts them on every machine of an allocation), container=agent-to-sim.sif
# (the image of envs/apptainer.def that jobs run in, with --software-deployment-method apptainer).
import gc
import shlex
import sys
from functools import partial

sys.path.insert(0, workflow.basedir)
from pipeline.workflow import dag, engine

# The collector walks the whole graph of jobs again and again: 8 % of the time on 3,000 recordings, the same memory.
gc.set_threshold(100_000, 20, 1000)

HOMES = engine.homes(config)
GPUS = int(config.get("gpu", 0))
TOGETHER = f"--processes {int(config.get('processes', max(1, GPUS)))}"
if config.get("launcher"):
    TOGETHER += f" --launcher {shlex.quote(config['launcher'])}"
if workflow.is_main_process:
    engine.plan(HOMES)
if config.get("container"):
    container: config["container"]


wildcard_constraints:
    home=engine.HOME,
    part="[a-z0-9_-]+",


rule all:
    input: engine.targets(HOMES) if workflow.is_main_process else []
    localrule: True


for node in dag.FLOW:
    rule:
        name: node.artifact
        input: partial(engine.inputs, node)
        output: engine.output(node)
        threads: node.threads
        resources:
            mem_mb=partial(engine.memory_mb, node),
            runtime=partial(engine.runtime_min, node),
            gpu=GPUS if node.gpu else 0,
            attempt=lambda wildcards, attempt: attempt,
        params:
            id=engine.job_pattern(node),
            python="python" if config.get("container") else sys.executable,
            together=TOGETHER if node.distributed else "",
        shell:
            "{params.python} -SE -m pipeline.workflow.run {params.together} --attempt {resources.attempt} "
            "{wildcards.home} {params.id}"
