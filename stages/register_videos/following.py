"""Where the phone tells no odometry: pictures with depth are followed from one to the next, and votes are carried along.

A motion that pictures do not tell (darkness, a cut) tears the recording into pieces, as a jump of the phone's own odometry
does; votes agree only within a piece.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.files.clips import Clip, Masks
from pipeline.progress import track
from pipeline.space import rigid, tears, visual_odometry
from pipeline.space.visual_odometry import Followed, FollowOptions
from stages.register_videos import alignment
from stages.register_videos.alignment import AlignOptions
from stages.register_videos.votes import VoteOptions, Votes, close


def follow(clip: Clip, masks: Masks, options: FollowOptions, rng: np.random.Generator) -> Followed:
    """Make odometry from the pictures, the agent masked out."""

    def view(frame: int) -> visual_odometry.Look:
        depth = np.where(clip.confidence(frame) >= 1, clip.depth(frame), 0)
        return visual_odometry.look(
            clip.color(frame), depth, clip.intrinsics[frame], clip.depth_intrinsics[frame], masks[frame] == 0, options
        )

    return visual_odometry.follow((view(frame) for frame in track(range(len(clip)), "following pictures")), options, rng)


def keep(clip: Clip, align: AlignOptions, options: FollowOptions) -> Followed:
    """Keep the phone's own odometry, mended and held loosely where it is torn."""
    torn = tears.torn(clip.timestamp_s, clip.odometry_from_camera)
    odometry = tears.mended(clip.timestamp_s, clip.odometry_from_camera, torn)
    edges, loose = alignment.odometry_edges(clip.timestamp_s, odometry, align), np.where(torn, options.torn, 1.0)[1:]
    return Followed(odometry, torn, replace(edges, sigma_rad=loose * edges.sigma_rad, sigma_m=loose * edges.sigma_m))


def agree_nearby(
    votes: Votes, timestamp_s: Float[np.ndarray, "frame"], followed: Followed, options: VoteOptions
) -> Bool[np.ndarray, "vote"]:
    """Tell which votes most of the others near in time confirm, carried along by what was followed."""
    voted, time, piece = votes.world_from_camera, timestamp_s[votes.frame], np.cumsum(followed.torn)[votes.frame]
    odometry, supports = followed.odometry_from_camera[votes.frame], np.zeros(len(voted), bool)
    first, last = np.searchsorted(time, time - options.near_s, side="right"), np.searchsorted(time, time + options.near_s)
    for vote in range(len(voted)):
        near = np.arange(first[vote], last[vote])
        near = near[(piece[near] == piece[vote]) & (near != vote)]
        carried = voted[near] @ rigid.inverse(odometry[near]) @ odometry[vote]
        agreeing = close(carried, voted[vote], options)
        supports[vote] = agreeing.any() and (agreeing * votes.probability[near]).sum() >= 0.5 * votes.probability[near].sum()
    return supports


def anchored(votes: Votes, supports: Bool[np.ndarray, "vote"], followed: Followed) -> Bool[np.ndarray, "frame"]:
    """Tell which frames lie in a piece that at least one agreeing vote holds; the rest is interpolation."""
    piece = np.cumsum(followed.torn)
    return np.isin(piece, piece[votes.frame[supports]])


def carry(
    votes: Votes, supports: Bool[np.ndarray, "vote"], timestamp_s: Float[np.ndarray, "frame"], followed: Followed
) -> Float[np.ndarray, "frame 4 4"]:
    """Give every frame a pose: carried from the votes before and after it and blended; in time alone across a tear."""
    frame, voted = votes.frame[supports], votes.world_from_camera[supports]
    odometry, piece = followed.odometry_from_camera, np.cumsum(followed.torn)
    world_from_odometry = voted @ rigid.inverse(odometry[frame])
    after = np.minimum(np.searchsorted(frame, np.arange(len(timestamp_s))), len(frame) - 1)
    before = np.maximum(np.searchsorted(frame, np.arange(len(timestamp_s)), side="right") - 1, 0)
    ends, closeness = [], []
    for vote in (before, after):
        carried = piece[frame[vote]] == piece
        ends.append(np.where(carried[:, None, None], world_from_odometry[vote] @ odometry, voted[vote]))
        closeness.append(np.where(carried, 1.0, 1e-3) / (np.abs(timestamp_s - timestamp_s[frame[vote]]) + 1e-3))
    share = closeness[1] / (closeness[0] + closeness[1])
    return ends[0] @ rigid.exp(rigid.log(rigid.inverse(ends[0]) @ ends[1]) * share[:, None])
