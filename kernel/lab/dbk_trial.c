#include "dbk_trial.h"

#include <math.h>

#include <string.h>

#include "dbk_chance.h"

#define FORGET 1e-2   /* [m] clearance at which earlier failed premises no longer explain a violation */
#define APPROACH 1e-3 /* [m/s] own speed above which contact is the robot's violation */

typedef struct {
  uint64_t chance;
  double q[DBK_MAX_DOF], v[DBK_MAX_DOF], u[DBK_MAX_DOF];
  double sign[DBK_MAX_DOF];                            /* direction of joint motion that opens the nearest row */
  double worst_noise, measured[DBK_MAX_DOF], sent[DBK_MAX_DOF]; /* the state as last measured; dt sum u since */
  double rate[DBK_MAX_DOF], bias[DBK_JUDGE_THINGS][3];
  int32_t state_age, burst, seen_at, jitter, blame, in_contact;
  dbk_plan plan;
} loop;

static int32_t nearest_row(const dbk_ctx *ctx) {
  int32_t row = -1;
  for (int32_t r = 0; r < ctx->rows.count; ++r) {
    if (row < 0 || ctx->rows.h[r] < ctx->rows.h[row]) { row = r; }
  }
  return row;
}

/* full speed down a row's gradient, or bang-bang; every second mind brings other noise */
static void choose(const dbk_model *model, const dbk_ctx *ctx, const dbk_trial *trial, loop *s, dbk_in *in) {
  int32_t row = nearest_row(ctx);
  if (ctx->rows.count > 0 && dbk_chance(&s->chance) < 0.3) {
    row = (int32_t)(dbk_chance(&s->chance) * (double)ctx->rows.count);
  }
  const int32_t down = row >= 0 && dbk_chance(&s->chance) < trial->toward;
  for (int32_t k = 0; k < model->n; ++k) {
    double sign = dbk_chance(&s->chance) < 0.5 ? -1.0 : 1.0;
    if (down) { sign = ctx->rows.a[k][row] > (dbk_real)0 ? -1.0 : 1.0; }
    in->u_nom[k] = (dbk_real)sign * model->v_max[k];
  }
  s->worst_noise = dbk_chance(&s->chance) < 0.5 ? 1.0 : 0.0;
  s->jitter = dbk_chance(&s->chance) < 0.5;
}

/* which way each joint opens the nearest row; a coin where there is none */
static void find_signs(const dbk_model *model, const dbk_ctx *ctx, loop *s) {
  const int32_t row = nearest_row(ctx);
  for (int32_t k = 0; k < model->n; ++k) {
    if (row >= 0) {
      s->sign[k] = ctx->rows.a[k][row] > (dbk_real)0 ? 1.0 : -1.0;
    } else if (dbk_chance(&s->chance) < 0.01) {
      s->sign[k] = dbk_chance(&s->chance) < 0.5 ? -1.0 : 1.0;
    }
  }
}

/* the error that hides a thing best: away from the sphere that is nearest to it */
static void hide(const dbk_judge_body *body, const double at[DBK_JUDGE_SPHERES][3], const dbk_thing *thing,
                 double way[3]) {
  int32_t nearest = body->first[1];
  double best = 1e9, size = 0.0;
  for (int32_t i = body->first[1]; i < body->first[body->n_links]; ++i) {
    const double h = dbk_thing_distance(thing, at[i]) - body->radius[i];
    if (h < best) {
      best = h;
      nearest = i;
    }
  }
  for (int32_t i = 0; i < 3; ++i) {
    double other[3] = {at[nearest][0], at[nearest][1], at[nearest][2]};
    other[i] += 1e-6;
    way[i] = dbk_thing_distance(thing, at[nearest]) - dbk_thing_distance(thing, other);
    size += way[i] * way[i];
  }
  for (int32_t i = 0; i < 3; ++i) { way[i] /= fmax(sqrt(size), 1e-12); }
}

/* the camera's newest frame, with errors at their bound */
static void look(const dbk_trial *trial, const dbk_judge_body *body, const dbk_judge *judge, const dbk_thing *things,
                 int32_t n_things, int32_t t, loop *s, dbk_scene *scene) {
  if (t > 0 && (t % trial->frame != 0 ||
                (t - s->seen_at + trial->frame <= trial->scene_longest && dbk_chance(&s->chance) < trial->scene_drop))) {
    return;
  }
  for (int32_t o = 0; o < n_things; ++o) {
    double off[3] = {0, 0, 0};
    if (t == 0 || s->jitter) { dbk_direction(&s->chance, s->bias[o]); }
    if (things[o].moving) { dbk_direction(&s->chance, off); }
    if (s->worst_noise > 0.5) {
      hide(body, judge->at, &things[o], s->bias[o]);
      if (things[o].moving) { memcpy(off, s->bias[o], sizeof off); }
    }
    for (int32_t i = 0; i < 3; ++i) {
      scene->obstacle[o].position[i] = (dbk_real)(things[o].position[i] + trial->place_noise * s->bias[o][i]);
      scene->obstacle[o].velocity[i] = (dbk_real)(trial->told * (things[o].velocity[i] + trial->speed_noise * off[i]));
    }
  }
  s->seen_at = t;
  dbk_scene_prepare(scene);
}

/* the newest state that arrived, or what the caller reckons from it */
static void feel(const dbk_model *model, const dbk_trial *trial, loop *s, dbk_in *in) {
  if (s->burst > 0) {
    --s->burst;
    ++s->state_age;
  } else {
    s->state_age = 0;
    for (int32_t k = 0; k < model->n; ++k) {
      const double a = s->worst_noise > 0.5 ? s->sign[k] : dbk_either(&s->chance);
      const double b = s->worst_noise > 0.5 ? s->sign[k] : dbk_either(&s->chance);
      s->measured[k] = s->q[k] + trial->q_noise * a;
      s->rate[k] = s->v[k] + trial->v_noise * b;
      s->sent[k] = 0.0;
    }
    if (trial->state_longest > 0 && dbk_chance(&s->chance) < trial->state_drop) {
      s->burst = 1 + (int32_t)(dbk_chance(&s->chance) * (double)trial->state_longest);
    }
  }
  for (int32_t k = 0; k < model->n; ++k) {
    in->q[k] = (dbk_real)(s->measured[k] + (trial->reckon ? s->sent[k] : 0.0));
    in->v[k] = (dbk_real)s->rate[k];
  }
  in->state_age = (dbk_real)((double)s->state_age * (double)model->period);
}

/* ydot = u + r exactly, q a first-order lag of y */
static void integrate(const dbk_model *model, const dbk_trial *trial, loop *s) {
  const double dt = (double)model->period;
  for (int32_t k = 0; k < model->n; ++k) {
    const double u = s->u[k] - trial->push * s->sign[k];
    if (trial->lag > 0.0) {
      const double fade = exp(-dt / trial->lag);
      s->q[k] += u * dt + (s->v[k] - u) * trial->lag * (1.0 - fade);
      s->v[k] = u + (s->v[k] - u) * fade;
    } else {
      s->q[k] += u * dt;
      s->v[k] = u;
    }
    s->sent[k] += dt * s->u[k];
  }
}

/* the control of this period; what failed of the premises, as bits */
static int32_t control(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_trial *trial, dbk_in *in,
                       loop *s, dbk_account *account) {
  dbk_out out;
  int32_t failed = s->state_age > 0 ? DBK_NOT_FRESH : 0;
  if (dbk_chance(&s->chance) < trial->late) { return failed | DBK_NOT_ON_TIME; }
  const dbk_status status = dbk_step(model, scene, ctx, in, &out);
  ++account->status[status];
  account->rows += out.n_rows;
  account->iterations += out.iterations;
  if (out.iterations > account->most_iterations) { account->most_iterations = out.iterations; }
  if (out.n_rows > account->most_rows) { account->most_rows = out.n_rows; }
  for (int32_t k = 0; k < model->n; ++k) {
    const double change = fabs((double)out.u[k] - s->u[k]);
    account->jerks += change > (double)model->a_max[k] * (double)model->period * (1.0 + 1e-5) + 1e-6;
    s->u[k] = (double)out.u[k];
  }
  if (out.flags & (DBK_STALE_STATE | DBK_STALE_SCENE)) { failed |= DBK_NOT_FRESH; }
  if (out.flags & (DBK_INFEASIBLE | DBK_UNAVOIDABLE | DBK_NO_GRADIENT)) { failed |= DBK_NOT_FEASIBLE; }
  return failed | (out.certified ? 0 : DBK_NOT_CERTIFIED);
}

static void count_moving(const dbk_verdict *verdict, loop *s, dbk_account *account) {
  const int32_t class = s->plan.evadable != 0;
  ++account->attacked[class];
  account->h_moving[class] = fmin(account->h_moving[class], verdict->moving);
  const int32_t contact = verdict->moving < 0.0, own = contact && verdict->approach > APPROACH;
  account->touched[class] += contact;
  account->moving[class][s->blame] += own;
  if (contact) { account->approach[class] = fmax(account->approach[class], verdict->approach); }
  if (contact && !s->in_contact) {
    ++account->contacts[class];
    account->approaching[class] += own;
  }
  s->in_contact = contact;
}

static void count(const dbk_verdict *verdict, int32_t t, int32_t failed, int32_t moving, loop *s, dbk_account *account) {
  const double still = fmin(verdict->still, fmin(verdict->self, verdict->joint));
  ++account->steps;
  for (int32_t p = 0; p < 4; ++p) { account->held[p] += !(failed & (1 << p)); }
  account->held[4] += failed == 0;
  s->blame = (fmin(still, verdict->moving) > FORGET ? 0 : s->blame) | failed;
  account->still[s->blame] += still < 0.0;
  if (verdict->still < account->h_still) {
    account->h_still = verdict->still;
    account->worst_step = t;
  }
  account->h_self = fmin(account->h_self, verdict->self);
  account->h_joint = fmin(account->h_joint, verdict->joint);
  if (moving >= 0) { count_moving(verdict, s, account); }
}

/* touching stops a mover, and it withdraws: what it would do to a body that it has met is not ours to tell */
static void withdraw(const dbk_judge_body *body, const dbk_judge *judge, const dbk_trial *trial, double period, loop *s,
                     dbk_thing *mover) {
  double way[3];
  hide(body, judge->at, mover, way);
  for (int32_t i = 0; i < 3; ++i) {
    mover->velocity[i] = 0.0;
    s->plan.target[i] = trial->mover.speed * way[i];
  }
  s->plan.left = (int32_t)(0.5 / period);
  s->plan.attack = 0;
}

static int32_t first_mover(const dbk_thing *things, int32_t n_things) {
  for (int32_t o = 0; o < n_things; ++o) {
    if (things[o].moving) { return o; }
  }
  return -1;
}

void dbk_run_trial(const dbk_model *model, dbk_scene *scene, dbk_ctx *ctx, const dbk_judge_body *body, dbk_thing *things,
                   int32_t n_things, const dbk_trial *trial, double *q, double *q_log, dbk_account *account) {
  static const dbk_account nothing = {.h_still = 1e3, .h_self = 1e3, .h_joint = 1e3, .h_moving = {1e3, 1e3},
                                      .approach = {-1e3, -1e3}};
  const int32_t n = model->n, moving = first_mover(things, n_things);
  const double period = (double)model->period;
  dbk_in in;
  loop s = {.chance = trial->seed};
  dbk_judge judge;
  dbk_verdict verdict;
  *account = nothing;
  memset(&in, 0, sizeof in);
  ctx->rows.count = 0;
  memcpy(s.q, q, sizeof(double) * (size_t)n);
  dbk_judge_reset(&judge);
  dbk_judge_look(body, &judge, s.q, things, n_things, period, &verdict);
  for (int32_t t = 0; t < trial->steps; ++t) {
    if (moving >= 0 && s.plan.left-- <= 0) {
      dbk_mover_plan(&trial->mover, body, s.q, s.v, things, n_things, moving, period, &s.chance, &s.plan);
      ++account->plans[s.plan.evadable != 0];
    }
    find_signs(model, ctx, &s);
    look(trial, body, &judge, things, n_things, t, &s, scene);
    feel(model, trial, &s, &in);
    if (t % trial->hold == 0) { choose(model, ctx, trial, &s, &in); }
    in.scene_age = (dbk_real)((double)(t - s.seen_at) * period);
    const int32_t failed = control(model, scene, ctx, trial, &in, &s, account);
    integrate(model, trial, &s);
    if (moving >= 0) { dbk_mover_step(&trial->mover, &s.plan, period, &things[moving]); }
    dbk_judge_look(body, &judge, s.q, things, n_things, period, &verdict);
    const int32_t before = s.in_contact;
    count(&verdict, t, failed, moving, &s, account);
    if (s.in_contact && !before) { withdraw(body, &judge, trial, period, &s, &things[moving]); }
    if (q_log) { memcpy(q_log + (int64_t)t * n, s.q, sizeof(double) * (size_t)n); }
  }
  memcpy(q, s.q, sizeof(double) * (size_t)n);
}
