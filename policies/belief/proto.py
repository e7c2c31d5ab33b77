"""Prototype trainer (to be replaced)."""
import sys, time, json, math, argparse
from pathlib import Path
import numpy as np, torch
from torch import nn
import torch.nn.functional as F
from hvs_suite.datasets import reader
from hvs_suite.datasets.demonstration import MakeEnvironment
from hvs_suite.datasets.recorder import in_order
from hvs_suite.policies.imitation.dagger import correct
from hvs_suite.policies.imitation.frame_cache import cached_frames, read_rows, new_frames
from hvs_suite.policies.imitation.remembered import _set_points
from hvs_suite.policies.network.dataset import read_manifest, EPISODE
from hvs_suite.policies.network import geometry
from hvs_suite.policies.belief import arm
from hvs_suite.policies.belief.belief import *
from hvs_suite.policies.belief.belief import BELIEF_SIZE
from hvs_suite.policies.belief.eye import sighting_loss, UV, LOG_DIAMETER, SLOPE, VISIBLE, LOG_SIGMA_UV, LOG_SIGMA_SIZE
from hvs_suite.policies.belief.network import *
from hvs_suite.policies.belief.cell_model import cell_model
from hvs_suite.reading import decode_png
from hvs_suite.errors import DatasetError
from hvs_suite.registry import find
from hvs_suite.rollout import play, one_torch_thread

IMG = "observation.images."

def load_columns(manifest):
    keys = [k for k, f in manifest.features.items() if f["dtype"] == "float32" and not k.startswith("next.") ]
    parts = {k: [] for k in [*keys, EPISODE]}
    for path in reader.data_files(manifest.root):
        t = reader.read_table(manifest.root, path.relative_to(manifest.root).as_posix(), [*keys, EPISODE])
        for k in parts:
            v = reader.column(t, k)
            parts[k].append(v.astype(np.int64) if k == EPISODE else v.astype(np.float32))
    return {k: np.concatenate(v) for k, v in parts.items()}

class Data:
    def __init__(self, network, goal_key):
        self.net = network; self.goal_key = goal_key
        self.cols = {}; self.images = []; self.starts = []; self.n = 0
        self.sight = {}
    def add(self, cols, images):
        cols = dict(cols)
        ep = cols[EPISODE]
        frames = np.arange(len(ep))
        first = np.maximum.accumulate(np.where(np.diff(ep, prepend=-1) != 0, frames, 0))
        cols["set_point"] = _set_points(cols["observation.state"], cols["privileged.action_executed"], first)
        cols["first"] = first + self.n
        if "privileged.goal_velocity" not in cols:
            cols["privileged.goal_velocity"] = np.zeros((len(ep), 3), np.float32)
        for k, v in cols.items():
            self.cols[k] = np.concatenate([self.cols[k], v]) if k in self.cols else v
        self.images.append(images); self.starts.append(self.n); self.n += len(ep)
    def finish(self, standoff):
        """per-frame truths as tensors"""
        c = self.cols
        nrm = torch.from_numpy(c["privileged.goal_normal"]).double()
        self.place = torch.from_numpy(c["privileged.goal_position"]).double() - standoff * nrm
        self.slope = nrm[:, :2] / nrm[:, 2:]
        self.velocity = torch.from_numpy(c["privileged.goal_velocity"]).double()
        self.state = torch.from_numpy(c["observation.state"])
        self.action = torch.from_numpy(c["action"])
        self.goal_pos = torch.from_numpy(c["privileged.goal_position"])
        self.setp = torch.from_numpy(c["set_point"])
        self.first = torch.from_numpy(c["first"])
        self.wrench = torch.from_numpy(c["observation.wrench"]) if self.net.shape.n_felt else None
        self.goal = torch.from_numpy(c[self.goal_key]) if self.goal_key else None
        self.truth = {n: torch.from_numpy(c[f"privileged.target_{n}"]) for n in self.net.shape.cameras}
        m = geometry.flange_motion(self.state[:, :7].double())
        self.views = self.net.views(m)
        self.cam_normal = {n: (v.rotation.transpose(1, 2) @ nrm[:, :, None])[:, :2, 0].float() for n, v in self.views.items()}
        last = np.append(np.flatnonzero(np.diff(c["first"]) != 0), self.n - 1)
        self.eps = [(int(c["first"][e]), int(e) + 1) for e in last]
    def pictures(self, rows):
        rows = np.sort(rows)
        out = {}
        owner = np.searchsorted(self.starts, rows, side="right") - 1
        for name in self.net.shape.cameras:
            k = IMG + name
            shp = self.images[0][k].shape[1:]
            buf = torch.empty((len(rows), *shp), dtype=torch.uint8); b = 0
            for i in np.unique(owner):
                r = rows[owner == i] - self.starts[i]
                read_rows(self.images[i][k], r, buf[b:b + len(r)].numpy()); b += len(r)
            out[name] = buf.permute(0, 3, 1, 2)
        return rows, out

def fit_prior(d, net):
    """standoff, sizes, prior from data; no task knowledge"""
    c = d.cols
    nrm = torch.from_numpy(c["privileged.goal_normal"]).double()
    g = torch.from_numpy(c["privileged.goal_position"]).double()
    m = geometry.flange_motion(torch.from_numpy(c["observation.state"][:, :7]).double())
    views = net.views(m)
    num = den = 0.0
    for n, v in views.items():
        if n != "eih": continue
        t = torch.from_numpy(c[f"privileged.target_{n}"]).double()
        ok = (t[:, 3] > .5) & (t[:, :2].abs().amax(1) < 1)
        ray = torch.cat([t[:, :2] * v.tan, torch.ones(len(t), 1, dtype=torch.float64)], 1)
        dirn = (v.rotation @ (ray / ray.norm(dim=1, keepdim=True))[:, :, None])[:, :, 0]
        off = g - v.origin
        A = lambda x: x - (x * dirn).sum(1, keepdim=True) * dirn
        w = ok / off.norm(dim=1).square()
        num += (w * (nrm * A(off)).sum(1)).sum(); den += (w * (nrm * A(nrm)).sum(1)).sum()
    # the rays of straight looks say nothing of it; then the targets' own depth stays unknown: 0.05
    s_rays = float(num / den)
    spec = d.spec
    s = s_rays
    place = g - s * nrm
    sizes = {}
    for n, v in views.items():
        t = torch.from_numpy(c[f"privileged.target_{n}"]).double()
        ok = (t[:, 3] > .5) & (t[:, :2].abs().amax(1) < 1)
        depth = (v.rotation.transpose(1, 2) @ (place - v.origin)[:, :, None])[:, 2, 0]
        sizes[n] = float((t[ok, 2] * depth[ok]).median()) if ok.any() else 0.02
    vel = torch.from_numpy(c["privileged.goal_velocity"]).double()
    mean = place.mean(0)
    cov = torch.zeros(9, 9, dtype=torch.float64)
    ep = torch.from_numpy(c[EPISODE]); same = ep[1:] == ep[:-1]
    acc = (vel[1:] - vel[:-1])[same] / net.cell.period_s
    cov[6:, 6:] = torch.diag(1.5 * acc.square().mean(0)) + torch.eye(3) * 1e-5 ** 2
    x = place - mean
    cov[:3, :3] = 1.5 * x.T @ x / len(x) + torch.eye(3) * (2e-5) ** 2
    cov[3:6, 3:6] = 1.5 * vel.T @ vel / len(vel) + torch.eye(3) * 1e-5 ** 2
    sl = nrm[:, :2] / nrm[:, 2:]
    pr = Prior(mean, cov, sl.mean(0), float(1.5 * sl.var() + 1e-7), s, sizes)
    print("prior", mean, cov.diagonal().sqrt(), pr.slope_variance ** .5, s, sizes, flush=True)
    return pr

def cosine(share, warm=0.03):
    return min(1, share / warm) * 0.5 * (1 + math.cos(math.pi * min(1, share))) + 1e-3

class Trainer:
    def __init__(self, a):
        self.a = a
        torch.set_num_threads(a.threads)
        torch.manual_seed(a.seed)
        self.rng = np.random.default_rng(a.seed)
        self.man = man = read_manifest(Path(a.data))
        self.spec = spec = find(man.task).with_options(man.options)
        cams = {n: (s[2], s[0]) for n, s in man.cameras.items()}
        extra = [k for k in man.features if k.startswith("observation.") and not k.startswith(IMG) and k != "observation.state"]
        goal_key = next((k for k in extra if "goal" in k), None)
        n_goals = man.features[goal_key]["shape"][0] if goal_key else 0
        n_felt = man.features["observation.wrench"]["shape"][0] if "observation.wrench" in man.features else 0
        shape = Shape(cams, n_goals, n_felt, error_scale=5e-3 * spec.tightest_tolerance_mm)
        self.cell = cell_model(spec)
        self.net = BeliefNetwork(shape, self.cell)
        self.goal_key = goal_key
        for e in self.net.eyes.values():
            e.train_in_bfloat16 = torch.cpu._is_avx512_bf16_supported()
        self.d = Data(self.net, goal_key); self.d.spec = spec
        cols = load_columns(man)
        t0 = time.time()
        images = {IMG + n: cached_frames(man.root, IMG + n, s, man.n_frames, Path(a.out) / "cache") for n, s in man.cameras.items()}
        print("decoded", man.n_frames, time.time() - t0, flush=True)
        self.d.add(cols, images)
        prior = fit_prior(self.d, self.net)
        self.net.belief.set_prior(prior); self.standoff = prior.standoff_m
        self.d.finish(self.standoff)
        eye_p = list(self.net.eyes.parameters())
        rest = [p for n, p in self.net.named_parameters() if not n.startswith("eyes.")]
        self.eye_opt = torch.optim.AdamW(eye_p, lr=2e-3, weight_decay=1e-4)
        self.opt = torch.optim.AdamW(rest, lr=2e-3, weight_decay=1e-4)
        self.eye_done = self.seq_done = 0
        self.next_scenario = man.n_episodes
        self.times = {}

    def clock(self, what, t0):
        self.times[what] = self.times.get(what, 0) + time.time() - t0

    def train_eyes(self, steps):
        t0 = time.time()
        net, d = self.net, self.d; net.train()
        recent = []
        for k in range(steps):
            share = self.eye_done / self.a.eye_steps
            for g in self.eye_opt.param_groups: g["lr"] = 2e-3 * cosine(share)
            rows, pics = d.pictures(self.rng.integers(0, d.n, 64))
            goal = d.goal[rows] if d.goal is not None else None
            s = net.look(pics, goal)
            loss = 0; parts = {}
            for n in s:
                l, p = sighting_loss(s[n], d.truth[n][rows], d.cam_normal[n][rows])
                loss = loss + l
                for q, v in p.items(): parts[f"{n}.{q}"] = v.item()
            self.eye_opt.zero_grad(); loss.backward()
            nn.utils.clip_grad_norm_(net.eyes.parameters(), 1.0)
            self.eye_opt.step(); self.eye_done += 1
            recent.append(parts)
            if self.eye_done % 250 == 0:
                m = {q: round(float(np.mean([r[q] for r in recent])), 4) for q in parts}
                print(f"eyes {self.eye_done} {(time.time()-t0)/(k+1)*1000:.0f} ms {m}", flush=True); recent = []
        self.clock("eyes", t0)

    @torch.no_grad()
    def cache(self, start=0):
        """what the eyes make of all frames"""
        t0 = time.time()
        net, d = self.net, self.d; net.eval()
        out = {n: [] for n in net.shape.cameras}
        for b in range(0, d.n, 256):
            rows, pics = d.pictures(np.arange(b, min(b + 256, d.n)))
            goal = d.goal[rows] if d.goal is not None else None
            for n, s in net.look(pics, goal).items(): out[n].append(s)
        d.sight = {n: torch.cat(v) for n, v in out.items()}
        for n, s in d.sight.items():
            t = d.truth[n]; ok = (t[:, 3] > .5) & (t[:, :2].abs().amax(1) < 1)
            e = (s[:, :2] - t[:, :2]).norm(dim=1)
            close = ok & (t[:, 2] > 0.1)
            se = (s[:, SLOPE] - d.cam_normal[n]).norm(dim=1)
            vis = ((s[:, 3] > 0) == (t[:, 3] > .5)).float().mean()
            q = lambda x: [round(float(v), 4) for v in x.quantile(torch.tensor([.5, .9, .99]))] if len(x) else []
            print(f"  {n}: uv err {q(e[ok][:100000])} size {q((s[ok,2]-t[ok,2].clamp(min=1e-3).log()).abs()[:100000])} slope close {q(se[close][:100000])} vis ok {vis:.4f}", flush=True)
        self.clock("cache", t0)

    @torch.no_grad()
    def refresh(self):
        """memory before each frame, by the present filter"""
        t0 = time.time()
        net, d = self.net, self.d; net.eval()
        eps = sorted(range(len(d.eps)), key=lambda e: d.eps[e][1] - d.eps[e][0])
        d.memory = torch.zeros(d.n, MEMORY_SIZE, dtype=torch.float64)
        final = []
        for b in range(0, len(eps), 512):
            group = [d.eps[e] for e in eps[b:b + 512]]
            starts = torch.tensor([g[0] for g in group]); lens = torch.tensor([g[1] - g[0] for g in group])
            T = int(lens.max()); mem = net.start(len(group))
            for t in range(T):
                act = t < lens
                rows = torch.where(act, starts + t, starts + lens - 1)
                mem[:, SET_POINT] = d.setp[rows]; mem[:, BEGUN] = 1.0
                d.memory[rows[act]] = mem[act]
                mem = net.remember(mem, {n: s[rows] for n, s in d.sight.items()}, d.state[rows, :7], {n: View(v.origin[rows], v.rotation[rows], v.tan) for n, v in d.views.items()})
                ends = t == lens - 1
                if ends.any():
                    r = rows[ends]; final.append(((mem[ends, :3] - d.place[r]).norm(dim=1) * 1000, torch.rad2deg((mem[ends, TILT] - d.slope[r]).norm(dim=1))))
        e = torch.cat([f[0] for f in final]); s = torch.cat([f[1] for f in final])
        q = lambda x: [round(float(v), 3) for v in x.quantile(torch.tensor([.5, .9, .99], dtype=x.dtype))]
        print(f"  belief at the end: place mm {q(e)} slope deg {q(s)}", flush=True)
        self.clock("refresh", t0)

    def jitter(self, sight, B, T):
        """eyes as they may be on pictures that they did not learn from"""
        out = {}
        for n, s in sight.items():
            s = s.clone()
            const = torch.randn(B, 1, 3).expand(B, T, 3).reshape(B * T, 3)
            z = 0.25 * torch.randn(len(s), 3) + 0.25 * const
            s[:, UV] += z[:, :2] * s[:, LOG_SIGMA_UV].clamp(-8, 2).exp()
            s[:, LOG_DIAMETER] += z[:, 2:] * s[:, LOG_SIGMA_SIZE].clamp(-8, 2).exp()
            out[n] = s
        return out

    def train_sequences(self, steps):
        t0 = time.time()
        net, d, a = self.net, self.d, self.a
        recent = []
        lens = np.array([e - s for s, e in d.eps]); begins = np.array([s for s, _ in d.eps])
        weights = lens / lens.sum()
        for k in range(steps):
            if k % a.refresh == 0: self.refresh()
            net.train()
            share = self.seq_done / a.seq_steps
            for g in self.opt.param_groups: g["lr"] = 2e-3 * cosine(share)
            B, T = a.windows, a.window
            ep = self.rng.choice(len(lens), B, p=weights)
            off = (self.rng.random(B) * np.maximum(1, lens[ep] - T + 1 + T // 2)).astype(int) - T // 4
            off = np.clip(off, 0, np.maximum(0, lens[ep] - T // 2))
            rows = begins[ep][:, None] + off[:, None] + np.arange(T)[None]
            mask = torch.from_numpy((off[:, None] + np.arange(T)[None]) < lens[ep][:, None])
            rows = torch.from_numpy(np.minimum(rows, (begins[ep] + lens[ep] - 1)[:, None]))
            flat = rows.flatten()
            sight = self.jitter({n: s[flat] for n, s in d.sight.items()}, B, T)
            seqs = {n: s.view(B, T, -1) for n, s in sight.items()}
            views = {n: View(v.origin[flat].view(B, T, 3), v.rotation[flat].view(B, T, 3, 3), v.tan) for n, v in d.views.items()}
            begin = torch.from_numpy(off == 0)
            mem = torch.where(begin[:, None], net.start(B), d.memory[rows[:, 0]])
            mems = []
            for t in range(T):
                mem = mem.clone()
                mem[:, SET_POINT] = d.setp[rows[:, t]]; mem[:, BEGUN] = 1.0
                mem = net.remember(mem, {n: s[:, t] for n, s in seqs.items()}, None if False else d.state[rows[:, t], :7], {n: View(v.origin[:, t], v.rotation[:, t], v.tan) for n, v in views.items()})
                mems.append(mem)
            memory = torch.stack(mems, 1).flatten(0, 1)
            m = mask.flatten()
            memory, flat = memory[m], flat[m]
            bl, bparts = belief_loss(memory[:, :BELIEF_SIZE], d.place[flat], d.velocity[flat], d.slope[flat], net.shape.error_scale)
            # extra frames for the head
            out = net.decide(memory, {n: s[m] for n, s in sight.items()}, d.state[flat], d.wrench[flat] if d.wrench is not None else None)
            label = net.encode_label(d.action[flat], memory)
            al = F.smooth_l1_loss(out, label, beta=0.3)
            tip = arm.tip_of(geometry.flange_motion(d.state[flat, :7]), self.cell.tool_length_m)
            astray = net.to_step(out) - net.to_step(label)
            v = (tip.jacobian @ astray[:, :, None])[:, :, 0]
            v = torch.cat([v[:, :3], 0.2 * v[:, 3:]], 1)
            dist = (d.goal_pos[flat] - tip.position).norm(dim=1, keepdim=True)
            fl = torch.asinh(v.norm(dim=1, keepdim=True) / (0.04 * net.shape.error_scale + 0.1 * dist)).mean()
            loss = al + 0.3 * fl + a.belief_weight * bl.float()
            self.opt.zero_grad(); loss.backward()
            nn.utils.clip_grad_norm_([p for g in self.opt.param_groups for p in g["params"]], 1.0)
            if not math.isfinite(loss.item()): raise SystemExit("nan")
            self.opt.step(); self.seq_done += 1
            parts = {"action": al.item(), "flange": fl.item(), **{q: x.item() for q, x in bparts.items()}}
            recent.append(parts)
            if self.seq_done % 100 == 0:
                mm = {q: round(float(np.mean([r[q] for r in recent])), 4) for q in parts}
                print(f"seq {self.seq_done} {(time.time()-t0)/(k+1)*1000:.0f} ms {mm}", flush=True); recent = []
        self.clock("sequences", t0)

    def save(self):
        path = Path(self.a.out) / "net.pt"
        torch.save({"state": self.net.state_dict(), "shape": self.net.shape, "cell": self.cell, "goal_key": self.goal_key}, path)
        return path

    def dagger(self, frames, k):
        t0 = time.time()
        path = self.save()
        man = self.man
        played = play(MakeEnvironment(man.task, man.split, dict(man.options)), Factory(str(path)),
                      range(self.next_scenario, self.next_scenario + frames), correct, workers=self.a.threads)
        n = ok = col = ne = 0
        cols = {}; folder = Path(self.a.out) / f"round-{k}"; folder.mkdir(exist_ok=True)
        images = {IMG + c: new_frames(folder / f"{c}.npy", (frames + 200, *s)) for c, s in man.cameras.items()}
        for ep in in_order(played, self.next_scenario):
            for key, pics in ep.pictures.items():
                for i, content in enumerate(pics): images[key][n + i] = decode_png(content, images[key].shape[1:], error=DatasetError)
            for key in ep.frames[0]:
                if key in self.d.cols or key.startswith("privileged") or key.startswith("observation"):
                    cols.setdefault(key, []).extend(f[key] for f in ep.frames)
            cols.setdefault(EPISODE, []).extend([ne] * len(ep.frames))
            n += len(ep.frames); ne += 1; ok += ep.success; col += ep.collision
            if n >= frames: break
        played.close()
        self.next_scenario += ne
        new = {k2: np.array(v) for k2, v in cols.items()}
        new = {k2: v for k2, v in new.items() if k2 in self.d.cols}
        self.d.add(new, {k2: v[:n] for k2, v in images.items()})
        self.d.finish(self.standoff)
        self.clock("play", t0)
        print(f"round {k}: {ok} of {ne} solved, {col} collisions, {n} frames, {time.time()-t0:.0f} s", flush=True)

class Factory:
    def __init__(self, path): self.path = path
    def __call__(self, env): return Player(self.path)

class Player:
    def __init__(self, path):
        with one_torch_thread():
            c = torch.load(path, weights_only=False)
            self.net = BeliefNetwork(c["shape"], c["cell"]); self.net.load_state_dict(c["state"]); self.net.eval()
        self.goal_key = c["goal_key"]; self.mem = None
    def reset(self): self.mem = None
    def select_action(self, o):
        with one_torch_thread(), torch.inference_mode():
            net = self.net
            pics = {n: torch.from_numpy(o[n]).permute(2, 0, 1)[None].contiguous() for n in net.shape.cameras}
            goal = torch.from_numpy(o[self.goal_key.removeprefix("observation.")].astype(np.float32))[None] if self.goal_key else None
            state = torch.from_numpy(np.concatenate([o["joint_positions"], o["joint_velocities"]]).astype(np.float32))[None]
            felt = torch.from_numpy(o["wrench"].astype(np.float32))[None] if net.shape.n_felt else None
            s = net.look(pics, goal)
            mem = net.start(1) if self.mem is None else self.mem
            mem = net.remember(mem, s, state[:, :7])
            out = net.decide(mem, s, state, felt)
            action = net.to_action(out, mem)
            self.mem = net.commanded(mem, action)
            return action[0].numpy().astype(np.float32)

def main():
    p = argparse.ArgumentParser()
    p.add_argument("--data"); p.add_argument("--out"); p.add_argument("--seed", type=int, default=0)
    p.add_argument("--eye-steps", type=int, default=4000); p.add_argument("--seq-steps", type=int, default=3000)
    p.add_argument("--rounds", type=int, default=3); p.add_argument("--frames", type=int, default=6000)
    p.add_argument("--windows", type=int, default=48); p.add_argument("--window", type=int, default=16)
    p.add_argument("--refresh", type=int, default=300); p.add_argument("--threads", type=int, default=2)
    p.add_argument("--belief-weight", type=float, default=1.0); p.add_argument("--eval", type=int, default=200)
    a = p.parse_args()
    Path(a.out).mkdir(parents=True, exist_ok=True)
    t = Trainer(a); r = a.rounds
    first = 0.5 if r else 1.0
    t.train_eyes(int(a.eye_steps * first)); t.cache(); t.train_sequences(int(a.seq_steps * 0.35 if r else a.seq_steps))
    for k in range(r):
        t.dagger(a.frames, k)
        t.train_eyes(int(a.eye_steps * (1 - first) / r)); t.cache()
        t.train_sequences(int(a.seq_steps * 0.65 / r))
    t.save()
    print({k: round(v) for k, v in t.times.items()}, flush=True)
    evaluate(a.out + "/net.pt", t.man.task, a.eval, a.threads)

def evaluate(path, task, n, workers):
    from hvs_suite.policies.imitation.dagger import watch
    t0 = time.time()
    played = play(MakeEnvironment(task, "dev", {}), Factory(path), range(n), outcome, workers=workers)
    res = [r for r in played]
    ok = [r for r in res if r[1]]
    print(f"EVAL {task} {path}: {len(ok)} of {n} solved, {sum(r[2] for r in res)} collisions, mean steps {np.mean([r[3] for r in ok]) if ok else 0:.2f}, {time.time()-t0:.0f} s", flush=True)
    bad = [r for r in res if not r[1]][:12]
    for r in bad: print("   lost", r, flush=True)

def outcome(env, policy, scenario):
    ts = env.reset(scenario=scenario)
    from hvs_suite.rollout import tell
    tell(policy, env); policy.reset(); n = 0
    while not ts.last():
        ts = env.step(np.clip(policy.select_action(ts.observation), -1, 1).astype(np.float32)); n += 1
    i = env.info
    return scenario, bool(i["is_success"]), bool(i["collision"]), n, {k: round(float(v), 3) for k, v in i["errors"].items()}

if __name__ == "__main__": main()
