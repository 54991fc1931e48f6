/* Rows of the barrier functions (paper 4.2): for a sphere at distance h along the outward normal n of an obstacle,
 *
 *   n'J u  >=  -alpha(h) + n'v_o + velocity_error + tracking * sum_k |n'J_k| + max(0, -dt/2 n'a)
 *
 * with a the centre's acceleration at constant u (the sampling term), alpha(h) = alpha h, and for h < 0 the recovery
 * min(alpha |h|, recovery). A row is left out only when no control of the box can violate it and h is above a floor.
 * Where contact is permitted, the contact-speed row n'(J u - v_o) >= -max(speed, alpha h) takes its place. Where speed and
 * separation are asked for, n'J u >= -v_max(h) holds as well, as far as braking can follow it.
 */
#include "dbk_math.h"

/* what is the same for all spheres of one visit */
typedef struct {
  dbk_real margin, alpha, cap, error, half_period, velocity[3];
  int32_t permitted, moving, rank;
  dbk_real reaction, brake, approach; /* brake 0: no speed and separation */
} terms;

/* distances, row right sides and room to violation, one array each */
typedef struct {
  dbk_real h[DBK_ALL_SPHERES], nx[DBK_ALL_SPHERES], ny[DBK_ALL_SPHERES], nz[DBK_ALL_SPHERES];
  dbk_real rhs[DBK_ALL_SPHERES], room[DBK_ALL_SPHERES];
  int32_t separating[DBK_ALL_SPHERES]; /* speed and separation is what binds */
} visit;

/* keep the row; when full, the smallest h stay and the overflow is told */
static void push(dbk_rows *rows, const visit *w, int32_t at, const dbk_cloud *cloud, const terms *t, int32_t kind,
                 int32_t i, int32_t j, int32_t from, int32_t upto) {
  int32_t r = rows->count;
  if (r >= DBK_MAX_ROWS) {
    rows->overflow = 1;
    r = 0;
    for (int32_t other = 1; other < DBK_MAX_ROWS; ++other) {
      if (rows->h[other] > rows->h[r]) { r = other; }
    }
    if (!(w->h[at] < rows->h[r])) { return; }
  } else {
    rows->count = r + 1;
  }
  const dbk_real nx = w->nx[at], ny = w->ny[at], nz = w->nz[at];
  const dbk_real x = cloud->x[i], y = cloud->y[i], z = cloud->z[i];
  rows->h[r] = w->h[at];
  rows->b[r] = w->rhs[at];
  rows->nx[r] = nx;
  rows->ny[r] = ny;
  rows->nz[r] = nz;
  rows->mx[r] = y * nz - z * ny;
  rows->my[r] = z * nx - x * nz;
  rows->mz[r] = x * ny - y * nx;
  rows->from[r] = from;
  rows->upto[r] = upto;
  rows->kind[r] = kind;
  rows->i[r] = i;
  rows->j[r] = j;
  rows->yielding[r] = t->permitted || !(w->h[at] >= (dbk_real)0) || (t->brake > (dbk_real)0 && w->separating[at]);
  rows->moving[r] = t->moving;
  rows->rank[r] = t->rank;
}

/* v_max from d = v_h (T_r + T_s) + v T_r + v^2 / (2 a), T_s = v / a: the speed toward a person at which the robot still
 * stops in time; 0 when even a robot at rest is too near */
static dbk_real separation_speed(const terms *t, dbk_real d, dbk_real person) {
  const dbk_real late = t->reaction + person / t->brake, spare = d - person * t->reaction;
  if (!(spare > (dbk_real)0)) { return (dbk_real)0; }
  return t->brake * (dbk_sqrt(late * late + (dbk_real)2 * spare / t->brake) - late);
}

/* the tighter of the barrier and of speed and separation */
static void separate(const terms *t, int32_t count, visit *w) {
  for (int32_t s = 0; s < count; ++s) {
    const dbk_real toward = w->nx[s] * t->velocity[0] + w->ny[s] * t->velocity[1] + w->nz[s] * t->velocity[2];
    const dbk_real person = dbk_max(t->approach, toward + t->error);
    const dbk_real rhs = -separation_speed(t, w->h[s], dbk_max(person, (dbk_real)0));
    w->separating[s] = rhs > w->rhs[s];
    if (w->separating[s]) {
      w->room[s] -= rhs - w->rhs[s];
      w->rhs[s] = rhs;
    }
  }
}

/* h, right side and the room that the worst control of the box leaves, for spheres first..first+count-1 */
static void weigh(const dbk_cloud *cloud, const dbk_motion *motion, const terms *t, int32_t first, int32_t count,
                  const dbk_real reference[6], dbk_real other_spread, visit *restrict w) {
  const dbk_real margin = t->margin, alpha = t->alpha, cap = t->cap, error = t->error, dt2 = t->half_period;
  const dbk_real ox = t->velocity[0], oy = t->velocity[1], oz = t->velocity[2];
  const dbk_real bx = reference[3], by = reference[4], bz = reference[5];
  const dbk_real rx = reference[0], ry = reference[1], rz = reference[2];
  const dbk_real *restrict radius = cloud->r + first;
  const dbk_real *restrict vx = motion->vx + first, *restrict vy = motion->vy + first, *restrict vz = motion->vz + first;
  const dbk_real *restrict ax = motion->ax + first, *restrict ay = motion->ay + first, *restrict az = motion->az + first;
  const dbk_real *restrict spread = motion->spread + first;
  for (int32_t s = 0; s < count; ++s) {
    const dbk_real nx = w->nx[s], ny = w->ny[s], nz = w->nz[s];
    const dbk_real h = w->h[s] - radius[s] - margin;
    const dbk_real wanted = -alpha * h;
    const dbk_real barrier = wanted < cap ? wanted : cap;
    const dbk_real bend = -dt2 * (nx * (ax[s] - bx) + ny * (ay[s] - by) + nz * (az[s] - bz));
    const dbk_real rhs = barrier + (nx * ox + ny * oy + nz * oz) + error + (bend > (dbk_real)0 ? bend : (dbk_real)0);
    const dbk_real rate = nx * (vx[s] - rx) + ny * (vy[s] - ry) + nz * (vz[s] - rz);
    w->h[s] = h;
    w->rhs[s] = rhs;
    w->room[s] = rate - spread[s] - other_spread - rhs;
  }
}

/* what could reach h = 0 within one period is looked at again by the certificate */
static void remember(dbk_ctx *ctx, int32_t first, int32_t count, int32_t other) {
  const int32_t at = ctx->visits.count;
  if (at >= DBK_MAX_VISITS) {
    ctx->rows.overflow = 1;
    return;
  }
  ctx->visits.first[at] = (int16_t)first;
  ctx->visits.spheres[at] = (int16_t)count;
  ctx->visits.other[at] = (int16_t)other;
  ctx->visits.count = at + 1;
}

/* a run of spheres against one obstacle; returns the smallest h among them */
static dbk_real against_obstacle(const dbk_model *model, dbk_ctx *ctx, const dbk_obstacle *shape, const terms *t,
                                 int32_t first, int32_t count, int32_t index) {
  static const dbk_real still[6] = {0};
  const dbk_cloud *cloud = &ctx->cloud;
  visit w;
  dbk_distance(shape, count, cloud->x + first, cloud->y + first, cloud->z + first, w.h, w.nx, w.ny, w.nz);
  weigh(cloud, &ctx->motion, t, first, count, still, (dbk_real)0, &w);
  if (t->brake > (dbk_real)0) { separate(t, count, &w); }
  dbk_real least = w.h[0];
  for (int32_t s = 0; s < count; ++s) {
    least = dbk_min(least, w.h[s]);
    if (w.room[s] < (dbk_real)0 || (!t->permitted && w.h[s] < DBK_CULL_FLOOR)) {
      push(&ctx->rows, &w, s, cloud, t, DBK_ROW_OBSTACLE, first + s, index, 0, model->sphere_frame[first + s]);
    }
  }
  return least;
}

static int32_t first_of(const dbk_model *model, int32_t link) {
  return link == model->n_links ? model->n_spheres : model->link_first[link];
}

static int32_t last_of(const dbk_model *model, const dbk_scene *scene, int32_t link) {
  return link == model->n_links ? model->n_spheres + scene->n_held : model->link_first[link + 1];
}

/* what is the same for all links that meet one obstacle */
typedef struct {
  dbk_real alpha, speed; /* the obstacle's own speed at most */
  uint32_t parts;
  const terms *all;
} meeting;

/* does this link matter for an obstacle whose surface is `gap` from the middle of the link? Frame 0 is bolted down. */
static int32_t matters(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx, int32_t link, dbk_real gap,
                       const meeting *m) {
  if (!(m->parts >> link & 1u)) { return 0; }
  if (first_of(model, link) >= last_of(model, scene, link)) { return 0; }
  if (link < model->n_links && model->link_frame[link] == 0) { return 0; }
  const dbk_real h = gap - ctx->motion.bound_r[link]; /* no sphere of the link is nearer */
  if (m->all->brake > (dbk_real)0) {
    const dbk_real person = dbk_max(m->all->approach, m->speed);
    if (!(separation_speed(m->all, h, person) >= ctx->motion.speed[link])) { return 1; }
  }
  return !(h > DBK_CULL_FLOOR && m->alpha * h >= m->speed + ctx->motion.speed[link] &&
           h + model->sampling >= ctx->h_min);
}

/* one obstacle against all links; neighbouring links with the same permit are taken as one run of spheres */
static void obstacle_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, dbk_real age, dbk_real extra,
                          int32_t index) {
  dbk_real gap[DBK_ALL_LINKS], nx[DBK_ALL_LINKS], ny[DBK_ALL_LINKS], nz[DBK_ALL_LINKS];
  const int32_t n_links = model->n_links + (scene->n_held > 0 ? 1 : 0);
  dbk_obstacle shape = scene->obstacle[index];
  const dbk_real *v = shape.velocity;
  for (int32_t e = 0; e < 3; ++e) { shape.position[e] += v[e] * age; }
  const dbk_real speed = dbk_sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]) + shape.velocity_error;
  const dbk_real margin = shape.margin + shape.velocity_error * age + model->sampling + model->rounding + extra;
  const dbk_real alpha = shape.alpha > (dbk_real)0 ? shape.alpha : model->alpha;
  terms t = {margin,
             alpha,
             model->recovery,
             shape.velocity_error,
             (dbk_real)0.5 * model->period,
             {v[0], v[1], v[2]},
             0,
             !(shape.flags & DBK_STATIC),
             shape.rank,
             shape.reaction,
             shape.brake,
             shape.approach};
  const meeting m = {alpha, speed, shape.parts, &t};
  dbk_distance(&shape, n_links, ctx->motion.bound_x, ctx->motion.bound_y, ctx->motion.bound_z, gap, nx, ny, nz);
  int32_t end = 0;
  for (int32_t l = 0; l < n_links; l = end) {
    const int32_t held = l == model->n_links;
    const dbk_real around = margin + (held ? scene->held_error : (dbk_real)0);
    const dbk_real permit = scene->permit[l][index];
    const int32_t permitted = permit >= (dbk_real)0;
    end = l + 1;
    if (!matters(model, scene, ctx, l, gap[l] - around, &m)) { continue; }
    dbk_real fastest = ctx->motion.speed[l];
    while (end < model->n_links && scene->permit[end][index] == permit &&
           matters(model, scene, ctx, end, gap[end] - around, &m)) {
      fastest = dbk_max(fastest, ctx->motion.speed[end]);
      ++end;
    }
    t.margin = around;
    t.cap = permitted ? -permit : model->recovery;
    t.error = permitted ? (dbk_real)0 : shape.velocity_error;
    t.brake = permitted ? (dbk_real)0 : shape.brake;
    t.permitted = permitted;
    const int32_t first = first_of(model, l), count = last_of(model, scene, end - 1) - first;
    const dbk_real least = against_obstacle(model, ctx, &shape, &t, first, count, index);
    t.brake = shape.brake;
    if (permitted) { continue; }
    ctx->h_min = dbk_min(ctx->h_min, least + model->sampling);
    if (least < model->period * (speed + fastest) + DBK_CULL_FLOOR) { remember(ctx, first, count, index); }
  }
}

/* what is the same for all spheres of one pair of links */
typedef struct {
  int32_t far, from, upto, first, count;
  dbk_real margin, speed;
} link_pair;

/* no ball at (x, y, z) of radius r can come near link `far` in this step, nor does it matter for h_min */
static int32_t beyond(const dbk_model *model, const dbk_ctx *ctx, const link_pair *p, dbk_real x, dbk_real y,
                      dbk_real z, dbk_real r) {
  const dbk_motion *m = &ctx->motion;
  const dbk_real dx = m->bound_x[p->far] - x, dy = m->bound_y[p->far] - y, dz = m->bound_z[p->far] - z;
  const dbk_real h = dbk_sqrt(dx * dx + dy * dy + dz * dz) - m->bound_r[p->far] - r - p->margin;
  return h > DBK_CULL_FLOOR && model->alpha_self * h >= p->speed && h + model->sampling >= ctx->h_min;
}

/* one sphere against the spheres of link `far` */
static void against_sphere(const dbk_model *model, dbk_ctx *ctx, const link_pair *p, int32_t i) {
  const dbk_motion *m = &ctx->motion;
  const dbk_cloud *cloud = &ctx->cloud;
  const int32_t first = p->first;
  const dbk_obstacle ball = {.shape = DBK_CAPSULE, .flags = DBK_STATIC, .radius = cloud->r[i],
                             .position = {cloud->x[i], cloud->y[i], cloud->z[i]}};
  const terms t = {p->margin, model->alpha_self, model->recovery, (dbk_real)0, (dbk_real)0.5 * model->period, {0}, 0, 0,
                   DBK_RANK_BODY, (dbk_real)0, (dbk_real)0, (dbk_real)0};
  const dbk_real reference[6] = {m->vx[i], m->vy[i], m->vz[i], m->ax[i], m->ay[i], m->az[i]};
  visit w;
  dbk_distance(&ball, p->count, cloud->x + first, cloud->y + first, cloud->z + first, w.h, w.nx, w.ny, w.nz);
  weigh(cloud, m, &t, first, p->count, reference, m->spread[i], &w);
  dbk_real least = w.h[0];
  for (int32_t s = 0; s < p->count; ++s) {
    least = dbk_min(least, w.h[s]);
    if (w.room[s] < (dbk_real)0 || w.h[s] < DBK_CULL_FLOOR) {
      push(&ctx->rows, &w, s, cloud, &t, DBK_ROW_SELF, first + s, i, p->from, p->upto);
    }
  }
  ctx->h_min = dbk_min(ctx->h_min, least + model->sampling);
  if (least < model->period * p->speed + DBK_CULL_FLOOR) { remember(ctx, first, p->count, -1 - i); }
}

/* spheres of link `far` (moved by more joints) against those of link `near` */
static void against_link(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, int32_t near, int32_t far,
                         dbk_real extra) {
  const dbk_motion *m = &ctx->motion;
  const dbk_cloud *cloud = &ctx->cloud;
  const int32_t held = far == model->n_links;
  const int32_t first = first_of(model, far);
  const link_pair p = {far,
                       model->link_frame[near],
                       held ? model->n : model->link_frame[far],
                       first,
                       last_of(model, scene, far) - first,
                       model->self_margin + model->sampling + model->rounding + extra +
                           (held ? scene->held_error : (dbk_real)0),
                       m->speed[near] + m->speed[far]};
  if (p.count <= 0 || p.from == p.upto) { return; }
  if (beyond(model, ctx, &p, m->bound_x[near], m->bound_y[near], m->bound_z[near], m->bound_r[near])) { return; }
  for (int32_t i = model->link_first[near]; i < model->link_first[near + 1]; ++i) {
    if (!beyond(model, ctx, &p, cloud->x[i], cloud->y[i], cloud->z[i], cloud->r[i])) {
      against_sphere(model, ctx, &p, i);
    }
  }
}

/* rows that were handed in, as unit rows after all others */
static void user_rows(const dbk_model *model, const dbk_scene *scene, dbk_rows *rows) {
  for (int32_t u = 0; u < scene->n_user; ++u) {
    dbk_real square = (dbk_real)0;
    for (int32_t k = 0; k < model->n; ++k) { square += scene->user_a[u][k] * scene->user_a[u][k]; }
    const dbk_real norm = dbk_sqrt(square);
    if (!(norm > DBK_ZERO_GRADIENT)) {
      if (!(scene->user_b[u] <= (dbk_real)0)) { rows->unavoidable = 1; }
      continue;
    }
    if (rows->count >= DBK_MAX_ROWS) {
      rows->overflow = 1;
      return;
    }
    const int32_t r = rows->count++;
    for (int32_t k = 0; k < model->n; ++k) { rows->a[k][r] = scene->user_a[u][k] / norm; }
    rows->b[r] = scene->user_b[u] / norm;
    rows->h[r] = scene->user_h[u];
    rows->norm[r] = norm;
    rows->kind[r] = DBK_ROW_USER;
    rows->i[r] = u;
    rows->j[r] = 0;
    rows->moving[r] = rows->yielding[r] = 0;
    rows->rank[r] = scene->user_rank[u];
  }
}

/* n'J_k = z_k'(c x n) - n'(z_k x p_k), or n'z_k where joint k slides, for every row at once, then unit rows */
void dbk_finish_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx) {
  dbk_rows *rows = &ctx->rows;
  const int32_t count = rows->count;
  dbk_real square[DBK_MAX_ROWS], total[DBK_MAX_ROWS], best[DBK_MAX_ROWS], inverse[DBK_MAX_ROWS];
  const dbk_real *restrict rx = rows->mx, *restrict ry = rows->my, *restrict rz = rows->mz;
  const dbk_real *restrict nx = rows->nx, *restrict ny = rows->ny, *restrict nz = rows->nz;
  const int32_t *restrict from = rows->from, *restrict upto = rows->upto;
  for (int32_t r = 0; r < count; ++r) { square[r] = total[r] = best[r] = (dbk_real)0; }
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real *f = ctx->frames.rotation[k + 1];
    const dbk_real *p = ctx->frames.origin[k + 1];
    const dbk_real zx = f[2], zy = f[5], zz = f[8];
    const int32_t slides = model->joint_kind[k] == DBK_PRISMATIC;
    const dbk_real tx = slides ? (dbk_real)0 : zx, ty = slides ? (dbk_real)0 : zy, tz = slides ? (dbk_real)0 : zz;
    const dbk_real mx = slides ? -zx : zy * p[2] - zz * p[1], my = slides ? -zy : zz * p[0] - zx * p[2];
    const dbk_real mz = slides ? -zz : zx * p[1] - zy * p[0];
    const dbk_real lower = ctx->lower[k], upper = ctx->upper[k];
    dbk_real *restrict a = rows->a[k];
    for (int32_t r = 0; r < count; ++r) {
      const dbk_real full = (tx * rx[r] + ty * ry[r] + tz * rz[r]) - (mx * nx[r] + my * ny[r] + mz * nz[r]);
      const dbk_real mine = full * (dbk_real)((upto[r] > k) & (from[r] <= k)); /* a product, so that this vectorises */
      const dbk_real low = mine * lower, high = mine * upper;
      a[r] = mine;
      square[r] += mine * mine;
      total[r] += mine < (dbk_real)0 ? -mine : mine;
      best[r] += low > high ? low : high;
    }
  }
  for (int32_t r = 0; r < count; ++r) {
    const dbk_real norm = dbk_sqrt(square[r]);
    square[r] = norm;
    total[r] = rows->b[r] + model->tracking * total[r];
    inverse[r] = (dbk_real)1 / (norm > DBK_ZERO_GRADIENT ? norm : DBK_ZERO_GRADIENT);
  }
  int32_t kept = 0;
  for (int32_t r = 0; r < count; ++r) {
    const dbk_real norm = square[r];
    dbk_real b = total[r];
    if (!(norm > DBK_ZERO_GRADIENT)) {
      /* nothing can be done about this pair: fine if nothing is needed */
      const int32_t mount = rows->kind[r] == DBK_ROW_OBSTACLE && rows->upto[r] <= 1 && !rows->moving[r];
      if (!(b <= (dbk_real)0) && !mount) {
        if (rows->h[r] + model->sampling < (dbk_real)0) { rows->stuck = 1; }
        rows->unavoidable = 1;
      }
      continue;
    }
    /* recovery and contact rows ask for no more than the box can give */
    if (rows->yielding[r] && b > best[r] - DBK_QP_SHIFT * 4 * norm) { b = best[r] - DBK_QP_SHIFT * 4 * norm; }
    rows->b[kept] = b * inverse[r];
    rows->h[kept] = rows->h[r] + model->sampling;
    rows->norm[kept] = norm;
    if (kept != r) {
      for (int32_t k = 0; k < model->n; ++k) { rows->a[k][kept] = rows->a[k][r]; }
      inverse[kept] = inverse[r];
      rows->kind[kept] = rows->kind[r];
      rows->i[kept] = rows->i[r];
      rows->j[kept] = rows->j[r];
      rows->moving[kept] = rows->moving[r];
      rows->rank[kept] = rows->rank[r];
      rows->yielding[kept] = rows->yielding[r];
    }
    ++kept;
  }
  for (int32_t k = 0; k < model->n; ++k) {
    dbk_real *restrict a = rows->a[k];
    for (int32_t r = 0; r < kept; ++r) { a[r] *= inverse[r]; }
  }
  rows->count = kept;
  user_rows(model, scene, rows);
  /* empty rows fill the last vector */
  for (int32_t r = rows->count; r < DBK_MAX_ROWS && r % DBK_LANES != 0; ++r) {
    for (int32_t k = 0; k < model->n; ++k) { rows->a[k][r] = (dbk_real)0; }
    rows->b[r] = (dbk_real)-1e9;
    rows->soft[r] = (dbk_real)0;
  }
}

void dbk_build_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, dbk_real age, dbk_real extra,
                    int32_t known_only) {
  ctx->rows.count = ctx->rows.overflow = ctx->rows.stuck = ctx->rows.unavoidable = 0;
  ctx->visits.count = 0;
  ctx->h_min = (dbk_real)10; /* farther than any robot here reaches */
  for (int32_t o = 0; o < scene->n_obstacles; ++o) {
    if (!known_only || (scene->obstacle[o].flags & DBK_KNOWN)) { obstacle_rows(model, scene, ctx, age, extra, o); }
  }
  for (int32_t p = 0; p < model->n_pairs; ++p) {
    against_link(model, scene, ctx, model->pair[p][0], model->pair[p][1], extra);
  }
  if (scene->n_held > 0) {
    for (int32_t l = 0; l < model->n_held_links; ++l) {
      against_link(model, scene, ctx, model->held_link[l], model->n_links, extra);
    }
  }
  dbk_finish_rows(model, scene, ctx);
}
