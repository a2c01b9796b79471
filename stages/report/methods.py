"""The methods of a build in words, with BibTeX entries of what was really used, by the settings in its
manifests.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stages.report.collect import read_manifest

Folders = Mapping[str, Mapping[str | None, Path]]
"""Folders of every artifact, by recording; None where there is one in all."""


@dataclass(frozen=True)
class Method:
    """One sentence about one artifact; it holds where the settings are those of `when`."""

    artifact: str
    sentence: str
    cites: tuple[str, ...] = ()
    when: Mapping[str, Any] = field(default_factory=dict)

    def holds(self, settings: Mapping[str, Any]) -> bool:
        """Return whether the artifact was made in this way; a setting that it does not have decides
        nothing.
        """
        return all(settings.get(key, value) == value for key, value in self.when.items())


METHODS = (
    Method("frames", (
"The recordings were resampled to {rate_hz:g} "
"Hz and turned upright."
), ("yang2025agent",)),
    Method("flow", (
"Optical flow was estimated by "
"dense inverse search."
), ("kroeger2016fast",), {"backend": "search"}),
    Method("flow", "Optical flow was estimated by RAFT.", ("teed2020raft",), {"backend": "raft"}),
    Method("masks", (
"The agent was segmented by depth and motion, "
"without learned weights."
), (), {"backend": "weightless"}),
    Method("masks", (
"The agent was found by Grounding "
"DINO and tracked by SAM 2."
), ("liu2024grounding", "ravi2024sam"),
           {"backend": "foundation"}),
    Method("feature_basis", "Features were DAISY descriptors.", ("tola2010daisy",), {"backend": "daisy"}),
    Method("feature_basis", "Features were those of DINOv2.", ("oquab2024dinov2",), {"backend": "dinov2"}),
    Method("scene_template", (
"The walk-through was mapped by structure from motion and "
"fused into a signed distance field."
),
           ("schoenberger2016structure", "curless1996volumetric")),
    Method("scene_localizer", (
"Cameras were localized by matching patches "
"of features to the map."
), ("fischler1981random",),
           {"kind": "bank"}),
    Method("scene_localizer", (
"Cameras were localized by regressing "
"scene coordinates."
), ("fischler1981random",), {"kind": "coordinates"}),
    Method("scene_localizer", (
"Cameras were localized by "
"regressing their poses."
), (), {"kind": "regression"}),
    Method("reconstruction", "The scene was fused from depth; its colour, and the agent's "
"shape, bones and motion, were fitted to "
           "all recordings.", ("curless1996volumetric", "yang2025agent"), {"scene_geometry": "fused"}),
    Method("reconstruction", (
"Scene, agent, bones and motion were fitted to all "
"recordings by differentiable rendering."
),
           ("yang2025agent",), {"scene_geometry": "learned"}),
    Method("splats", "The result was refined as 3D Gaussians.", ("kerbl2023gaussian",)),
    Method("behavior", (
"Goals, paths and bodies were learned by hierarchical "
"diffusion with classifier-free guidance."
),
           ("yang2025agent", "ho2020denoising", "song2021denoising", "ho2022classifier"),
           {"family": "diffusion"}),
    Method("behavior", "The scene was encoded in pillars.", ("lang2019pointpillars",), {"scene": "pillars"}),
    Method("longterm", (
"Long-term motion was learned as bodies at sub-goals, routes "
"between them and poses along routes."
),
           ("wang2021synthesizing",)),
)  # fmt: skip
ENTRIES = {
    "curless1996volumetric": ("inproceedings", "Curless, Brian and Levoy, Marc", (
"A Volumetric Method for Building Complex "
"Models from Range Images"
), "SIGGRAPH", 1996),
    "fischler1981random": ("article", (
"Fischler, Martin A. and "
"Bolles, Robert C."
), (
"Random Sample Consensus: A Paradigm for Model Fitting with Applications "
"to Image Analysis and Automated Cartography"
), "Communications of the ACM", 1981),
    "ho2020denoising": ("inproceedings", (
"Ho, Jonathan and Jain, Ajay "
"and Abbeel, Pieter"
), (
"Denoising Diffusion "
"Probabilistic Models"
), "NeurIPS", 2020),
    "ho2022classifier": ("article", "Ho, Jonathan and Salimans, Tim",
        "Classifier-Free Diffusion Guidance", "arXiv:2207.12598", 2022),
    "kerbl2023gaussian": ("article", (
"Kerbl, Bernhard and Kopanas, Georgios and Leimk{\\\"u}hler, "
"Thomas and Drettakis, George"
), (
"3D Gaussian Splatting for Real-Time "
"Radiance Field Rendering"
), "ACM Transactions on Graphics", 2023),
    "kroeger2016fast": ("inproceedings", (
"Kroeger, Till and Timofte, Radu and Dai, "
"Dengxin and Van Gool, Luc"
), (
"Fast Optical Flow using "
"Dense Inverse Search"
), "ECCV", 2016),
    "lang2019pointpillars": ("inproceedings", (
"Lang, Alex H. and Vora, Sourabh and Caesar, Holger and Zhou, "
"Lubing and Yang, Jiong and Beijbom, Oscar"
), (
"PointPillars: Fast Encoders for Object "
"Detection from Point Clouds"
), "CVPR", 2019),
    "liu2024grounding": ("inproceedings", "Liu, Shilong and others", (
"Grounding DINO: Marrying DINO with Grounded Pre-Training "
"for Open-Set Object Detection"
), "ECCV", 2024),
    "oquab2024dinov2": ("article", "Oquab, Maxime and others", (
"DINOv2: Learning Robust Visual "
"Features without Supervision"
), (
"Transactions on Machine "
"Learning Research"
), 2024),
    "ravi2024sam": ("article", "Ravi, Nikhila and others", (
"SAM 2: Segment Anything in "
"Images and Videos"
), "arXiv:2408.00714", 2024),
    "schoenberger2016structure": ("inproceedings", (
"Sch{\\\"o}nberger, Johannes L. "
"and Frahm, Jan-Michael"
), "Structure-from-Motion Revisited", "CVPR", 2016),
    "song2021denoising": ("inproceedings", (
"Song, Jiaming and Meng, Chenlin "
"and Ermon, Stefano"
), "Denoising Diffusion Implicit Models", "ICLR", 2021),
    "teed2020raft": ("inproceedings", "Teed, Zachary and Deng, Jia", (
"RAFT: Recurrent All-Pairs Field "
"Transforms for Optical Flow"
), "ECCV", 2020),
    "tola2010daisy": ("article", (
"Tola, Engin and Lepetit, "
"Vincent and Fua, Pascal"
), (
"DAISY: An Efficient Dense Descriptor "
"Applied to Wide-Baseline Stereo"
), (
"IEEE Transactions on Pattern Analysis "
"and Machine Intelligence"
), 2010),
    "wang2021synthesizing": ("inproceedings", (
"Wang, Jiashun and Xu, Huazhe and Xu, Jingwei "
"and Liu, Sifei and Wang, Xiaolong"
), (
"Synthesizing Long-Term 3D Human Motion "
"and Interaction in 3D Scenes"
), "CVPR", 2021),
    "yang2025agent": ("inproceedings", (
"Yang, Gengshan and Bajcsy, Andrea and Saito, "
"Shunsuke and Kanazawa, Angjoo"
), (
"Agent-to-Sim: Learning Interactive Behavior Models "
"from Casual Longitudinal Videos"
), "ICLR", 2025),
}  # fmt: skip
"""BibTeX kind, authors, title, where it appeared, year."""


def paragraph(folders: Folders) -> str:
    """Return the methods of the build as one paragraph, citations as [key]."""
    return " ".join(
        method.sentence.removesuffix(".").format_map(settings)
        + (f" [{', '.join(method.cites)}]." if method.cites else ".")
        for method, settings in _used(folders)
    )


def document(folders: Folders) -> str:
    """Return the paragraph with the versions of what computed it, as Markdown."""
    manifests = (read_manifest(folder) for each in folders.values() for folder in each.values())
    versions = sorted({f"{name} {v}" for m in manifests if m for name, v in m["versions"].items()})
    computed = f"\n\nComputed with {', '.join(versions)}." if versions else ""
    return f"# Methods\n\n{paragraph(folders)}{computed}\n"


def bibliography(folders: Folders) -> str:
    """Return the BibTeX entries of everything that the paragraph cites."""
    cited = sorted({key for method, _ in _used(folders) for key in method.cites})
    return "\n".join(_entry(key) for key in cited)


def _used(folders: Folders) -> Iterator[tuple[Method, Mapping[str, Any]]]:
    for method in METHODS:
        manifest = next(
            (m for f in folders.get(method.artifact, {}).values() if (m := read_manifest(f))), None
        )
        if manifest is not None and method.holds(manifest["config"]):
            yield method, _Settings(manifest["config"])


class _Settings(dict[str, Any]):
    """Settings of which a sentence may name one that older artifacts did not have."""

    def __missing__(self, key: str) -> float:
        return float("nan")


def _entry(key: str) -> str:
    kind, authors, title, where, year = ENTRIES[key]
    place = "journal" if kind == "article" else "booktitle"
    rows = {"author": authors, "title": f"{{{title}}}", place: where, "year": year}
    return (
        f"@{kind}{{{key},\n" + "".join(f"  {name} = {{{value}}},\n" for name, value in rows.items()) + "}\n"
    )
