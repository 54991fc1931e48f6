/* dualbrain kernel: one step of a control barrier function filter, in C99.
 *
 * No heap, no recursion, no globals, no libm. The caller owns every byte: `model` and `scene` are read only in a step,
 * `ctx` carries the last control and the warm start. All values are SI; frames are the body's base frame, z up.
 *
 *   min 1/2 (u - u_nom)' R (u - u_nom)   subject to   A u >= b,   lo <= u <= hi                   (paper 4.3)
 */
#ifndef DBK_H
#define DBK_H

#include <stdint.h>

#include "dbk/dbk_config.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef enum { DBK_SAFE, DBK_MODIFIED, DBK_RELAXED, DBK_STOPPED, DBK_FAULT } dbk_status;

/* why a step ended as it did; several may be set */
enum {
  DBK_BAD_INPUT = 1,      /* a number is not finite */
  DBK_STALE_STATE = 2,    /* the joint state is too old, or from the future */
  DBK_STALE_SCENE = 4,    /* moving obstacles were seen too long ago */
  DBK_OUTSIDE = 8,        /* a joint is far outside its limits */
  DBK_ROW_OVERFLOW = 16,  /* more rows could bind than there is room for */
  DBK_NO_GRADIENT = 32,   /* h < 0 and no joint can change it */
  DBK_QP_ITERATIONS = 64, /* the QP did not end within its cap */
  DBK_INFEASIBLE = 128,   /* no control meets all rows within the box */
  DBK_BAD_SCENE = 256,    /* the obstacle table holds a number that is not finite */
  DBK_UNCERTIFIED = 512,  /* the next step would not keep h >= 0, even when braking */
  DBK_UNAVOIDABLE = 1024, /* something moves at a part of the body that cannot move away */
  DBK_JERK = 2048         /* another limit left no room for the jerk limit in this step; for information */
};

enum { DBK_CAPSULE, DBK_BOX, DBK_HALF_SPACE }; /* a sphere is a capsule of length 0 */
enum { DBK_KNOWN = 1, DBK_STATIC = 2 };
enum { DBK_ROW_OBSTACLE, DBK_ROW_SELF, DBK_ROW_LOWER, DBK_ROW_UPPER, DBK_ROW_USER };
enum { DBK_REVOLUTE, DBK_PRISMATIC };
enum { DBK_LIMIT_VELOCITY, DBK_LIMIT_ACCELERATION, DBK_LIMIT_JERK, DBK_LIMIT_POSITION };

/* what is given up last when no control meets all rows; the box is never given up */
enum { DBK_RANK_BODY = 1, DBK_RANK_OBSTACLE, DBK_RANK_WORKSPACE, DBK_RANK_TASK };

/* a ball around all spheres of a link: centre from that of the link's first sphere, in the link's frame */
typedef struct {
  dbk_real x, y, z, radius;
  dbk_real inner; /* least |centre of a sphere - centre of the ball| - its radius: the link comes at least that near */
} dbk_ball;

typedef struct {
  int32_t n; /* joints */
  dbk_real period, alpha, alpha_self, alpha_joint, recovery, sampling, rounding, self_margin, lag, tracking; /* s, 1/s, m/s, m, s, rad/s */
  dbk_real state_age_max, scene_age_max;                                            /* s */
  int32_t joint_kind[DBK_MAX_DOF]; /* a revolute joint turns about its z axis, a prismatic one slides along it */
  dbk_real joint_rotation[DBK_MAX_DOF][9], joint_offset[DBK_MAX_DOF][3];            /* row-major; parent <- joint at q = 0 */
  dbk_real q_lower[DBK_MAX_DOF], q_upper[DBK_MAX_DOF], v_max[DBK_MAX_DOF], a_max[DBK_MAX_DOF];
  dbk_real j_max[DBK_MAX_DOF]; /* [rad/s^3]; 0: no limit */
  dbk_real scale[DBK_MAX_DOF][DBK_MAX_DOF]; /* S = L^-T with R = L L': u = u_nom + S x, cost |x|^2 / 2 */
  dbk_real tool_rotation[9], tool_offset[3];
  int32_t n_links, n_spheres, n_pairs, n_held_links;
  int32_t link_frame[DBK_MAX_LINKS], link_first[DBK_MAX_LINKS + 1]; /* spheres of a link lie side by side */
  int32_t pair[DBK_MAX_PAIRS][2];                                   /* links that are kept apart */
  int32_t held_link[DBK_MAX_LINKS];                                 /* links that a held object is kept apart from */
  dbk_real x[DBK_MAX_SPHERES], y[DBK_MAX_SPHERES], z[DBK_MAX_SPHERES], radius[DBK_MAX_SPHERES]; /* in the link's frame */
  dbk_real slide_x[DBK_MAX_SPHERES], slide_y[DBK_MAX_SPHERES], slide_z[DBK_MAX_SPHERES]; /* shift per metre of opening */
  /* filled by dbk_prepare */
  dbk_real reach[DBK_MAX_DOF][DBK_SPHERE_ROOM]; /* longest lever arm of joint k on a sphere, any posture [m] */
  dbk_real link_reach[DBK_MAX_DOF][DBK_ALL_LINKS]; /* the longest among a link's spheres */
  int32_t sphere_frame[DBK_ALL_SPHERES];
  dbk_ball ball[DBK_MAX_LINKS];
} dbk_model;

typedef struct {
  int32_t shape, flags, rank;
  uint32_t parts; /* bit l: link l is kept away, bit n_links: what is held */
  dbk_real alpha; /* [1/s]; 0: the model's */
  dbk_real position[3], rotation[9]; /* columns are the local axes */
  dbk_real half[3], radius;          /* capsule: half[2] is the half length */
  dbk_real velocity[3], margin, velocity_error;
  dbk_real reaction, brake, approach; /* speed and separation: s, m/s^2 (0: off), least speed of the person m/s */
} dbk_obstacle;

/* a capsule around every obstacle but half-spaces, one array per number, so that a link meets all in one loop */
typedef struct {
  dbk_real x[DBK_OBSTACLE_ROOM], y[DBK_OBSTACLE_ROOM], z[DBK_OBSTACLE_ROOM];
  dbk_real ax[DBK_OBSTACLE_ROOM], ay[DBK_OBSTACLE_ROOM], az[DBK_OBSTACLE_ROOM], half[DBK_OBSTACLE_ROOM];
  dbk_real radius[DBK_OBSTACLE_ROOM], margin[DBK_OBSTACLE_ROOM], alpha[DBK_OBSTACLE_ROOM];
  dbk_real vx[DBK_OBSTACLE_ROOM], vy[DBK_OBSTACLE_ROOM], vz[DBK_OBSTACLE_ROOM];
  dbk_real error[DBK_OBSTACLE_ROOM], speed[DBK_OBSTACLE_ROOM]; /* of the velocity; the obstacle's own at most */
  uint32_t parts[DBK_OBSTACLE_ROOM];                           /* none behind the last obstacle */
  int32_t known[DBK_OBSTACLE_ROOM], moving[DBK_OBSTACLE_ROOM], rank[DBK_OBSTACLE_ROOM];
  int32_t plain[DBK_OBSTACLE_ROOM]; /* the capsule is the obstacle, and no speed and separation is asked for */
  int32_t ball[DBK_OBSTACLE_ROOM];  /* a ball at rest: without length, velocity and error of that */
  int32_t any_half_space, any_separation, any_long;
} dbk_covers;

typedef struct {
  int32_t ready; /* set by dbk_scene_prepare */
  int32_t n_obstacles, n_held, moving;
  dbk_obstacle obstacle[DBK_MAX_OBSTACLES];
  dbk_real permit[DBK_ALL_LINKS][DBK_MAX_OBSTACLES]; /* contact speed [m/s] where contact is permitted, else < 0 */
  dbk_real held_x[DBK_MAX_HELD], held_y[DBK_MAX_HELD], held_z[DBK_MAX_HELD], held_r[DBK_MAX_HELD]; /* in the last frame */
  dbk_real held_error;
  int32_t n_user, user_rank[DBK_MAX_USER];
  dbk_real user_a[DBK_MAX_USER][DBK_MAX_DOF], user_b[DBK_MAX_USER], user_h[DBK_MAX_USER]; /* a'u >= b */
  /* filled by dbk_scene_prepare */
  dbk_covers covers;
  dbk_ball held_ball;
} dbk_scene;

typedef struct {
  dbk_real q[DBK_MAX_DOF], v[DBK_MAX_DOF], u_nom[DBK_MAX_DOF];
  dbk_real opening, state_age, scene_age;
  int32_t mobile; /* 0: the base frame is the world; else it stands as follows */
  dbk_real base_rotation[9], base_position[3];
} dbk_in;

typedef struct {
  int32_t kind, i, j; /* obstacle row: sphere, obstacle; self row: sphere, sphere; box: joint, which limit */
  dbk_real h, multiplier;
} dbk_active;

typedef struct {
  dbk_real u[DBK_MAX_DOF];
  dbk_real delta, delta_rows, delta_box;
  dbk_real h_min; /* NaN where the input was refused: nothing was measured */
  int32_t status, flags, certified, iterations, n_rows, n_active;
  int32_t relaxed; /* bit r: rows of rank r were given up in part */
  dbk_active active[DBK_QP_DIM + 1]; /* binding rows, or the conflicting ones when relaxed */
} dbk_out;

/* chain: frame 0 is the base, frame i moves with joint i */
typedef struct {
  dbk_real rotation[DBK_MAX_DOF + 1][9], origin[DBK_MAX_DOF + 1][3];
} dbk_frames;

/* rows, one array per joint so that loops over rows vectorise. Rows that lie side by side and are moved by the same joints
 * are a span: its first row, the joints from..upto-1, and whether a batch of them was about several spheres. What (mx, my,
 * mz) holds is that span's affair: there c x n of a row, else c, with c the centre of its sphere */
typedef struct {
  int32_t count, overflow, stuck, unavoidable;
  int32_t n_spans, span_first[DBK_MAX_SPANS], span_from[DBK_MAX_SPANS], span_upto[DBK_MAX_SPANS];
  int32_t span_several[DBK_MAX_SPANS];
  dbk_real a[DBK_MAX_DOF][DBK_ROW_ROOM], b[DBK_ROW_ROOM]; /* unit rows */
  dbk_real h[DBK_ROW_ROOM], norm[DBK_ROW_ROOM];
  dbk_real nx[DBK_ROW_ROOM], ny[DBK_ROW_ROOM], nz[DBK_ROW_ROOM], mx[DBK_ROW_ROOM], my[DBK_ROW_ROOM], mz[DBK_ROW_ROOM];
  dbk_real soft[DBK_ROW_ROOM];
  int32_t kind[DBK_ROW_ROOM], i[DBK_ROW_ROOM], j[DBK_ROW_ROOM], yielding[DBK_ROW_ROOM], moving[DBK_ROW_ROOM];
  int32_t rank[DBK_ROW_ROOM];
} dbk_rows;

/* runs of spheres that one period could bring to h = 0 at an obstacle or sphere: what the certificate looks at again */
typedef struct {
  int32_t count;
  int16_t first[DBK_MAX_VISITS], spheres[DBK_MAX_VISITS], other[DBK_MAX_VISITS]; /* other: obstacle, or -1 - sphere */
} dbk_visits;

typedef struct {
  dbk_real x[DBK_SPHERE_ROOM], y[DBK_SPHERE_ROOM], z[DBK_SPHERE_ROOM], r[DBK_SPHERE_ROOM];
  int32_t count;
} dbk_cloud;

/* how sphere centres move: velocities under the middle of the trust box and how much that box can change them, and
 * accelerations under the middle of the whole box */
typedef struct {
  dbk_real vx[DBK_SPHERE_ROOM], vy[DBK_SPHERE_ROOM], vz[DBK_SPHERE_ROOM];
  dbk_real ax[DBK_SPHERE_ROOM], ay[DBK_SPHERE_ROOM], az[DBK_SPHERE_ROOM];
  dbk_real spread[DBK_SPHERE_ROOM];
  dbk_real fast[DBK_MAX_DOF], wide[DBK_MAX_DOF]; /* greatest |u| there, and half its width, with the tracking error */
  dbk_real beyond[DBK_MAX_DOF];                  /* the whole box reaches so much farther than the trust box */
  dbk_real twist[DBK_MAX_DOF + 1][6];            /* of every frame about the base origin: angular, linear */
  dbk_real bound_x[DBK_ALL_LINKS], bound_y[DBK_ALL_LINKS], bound_z[DBK_ALL_LINKS], bound_r[DBK_ALL_LINKS];
  dbk_real inner[DBK_ALL_LINKS]; /* see dbk_ball */
  dbk_real speed[DBK_ALL_LINKS]; /* no sphere of the link can be faster within the trust box */
  dbk_real haste[DBK_ALL_LINKS]; /* nor faster than this within the whole box */
  dbk_real bend[DBK_ALL_LINKS];  /* nor ask for more because of its acceleration: half a period times that [m/s] */
} dbk_motion;

typedef struct {
  int32_t n, n_active, iterations, infeasible; /* infeasible: active[] and multiplier[] are the Farkas certificate */
  int32_t active[DBK_QP_DIM + 1];              /* 0..n-1 lower bounds, n..2n-1 upper bounds, 2n.. rows */
  dbk_real multiplier[DBK_QP_DIM + 1];
  dbk_real u[DBK_MAX_DOF], slack;
} dbk_solution;

typedef struct {
  dbk_real u_prev[DBK_MAX_DOF], u_nom_prev[DBK_MAX_DOF], change[DBK_MAX_DOF]; /* change: last u_prev - the one before */
  int32_t n_warm, warm[DBK_QP_DIM][3]; /* kind, i, j of the rows that were active */
  /* work of one step */
  dbk_frames frames;
  dbk_cloud cloud, next;
  dbk_motion motion;
  dbk_rows rows;
  dbk_visits visits;
  int32_t glances; /* spheres that were held against all spheres of another link */
  dbk_solution solution;
  dbk_real lower[DBK_MAX_DOF], upper[DBK_MAX_DOF], h_min;
  dbk_real trust_lower[DBK_MAX_DOF], trust_upper[DBK_MAX_DOF]; /* where rows are looked for; see dbk_trust.c */
  int32_t trusted;                                             /* that is less than the whole box */
} dbk_ctx;

/* once per model and per scene */
void dbk_prepare(dbk_model *model);
void dbk_scene_prepare(dbk_scene *scene);
void dbk_scene_clear(dbk_scene *scene);
void dbk_init(dbk_ctx *ctx);

/* one control step: closest safe control to u_nom; out->u is always finite and within the acceleration box */
dbk_status dbk_step(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in, dbk_out *out);

/* completes ctx->rows after a step by those that were left out because its answer could not violate them; `in` and `scene`
 * are still those of the step */
void dbk_all_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in);

/* the same rows on known obstacles with `extra` clearance and the box around u_prev; no certificate, no memory of u */
dbk_status dbk_project(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in,
                       const dbk_real u_prev[DBK_MAX_DOF], dbk_real extra, dbk_real u[DBK_MAX_DOF]);

/* parts, public for tests */
void dbk_sincos(dbk_real x, dbk_real *sine, dbk_real *cosine);
/* frame 0 must be set: dbk_base does */
void dbk_base(const dbk_in *in, dbk_frames *frames);
void dbk_fk(const dbk_model *model, const dbk_real q[DBK_MAX_DOF], dbk_frames *frames);
void dbk_spheres(const dbk_model *model, const dbk_scene *scene, const dbk_frames *frames, dbk_real opening,
                 dbk_cloud *cloud);
void dbk_jacobian(const dbk_model *model, const dbk_frames *frames, const dbk_real point[3], dbk_real linear[3][DBK_MAX_DOF],
                  dbk_real angular[3][DBK_MAX_DOF]);
void dbk_distance(const dbk_obstacle *shape, int32_t count, const dbk_real *x, const dbk_real *y, const dbk_real *z,
                  dbk_real *d, dbk_real *nx, dbk_real *ny, dbk_real *nz);
void dbk_box(const dbk_model *model, const dbk_real y[DBK_MAX_DOF], const dbk_real u_prev[DBK_MAX_DOF],
             dbk_real lower[DBK_MAX_DOF], dbk_real upper[DBK_MAX_DOF], int32_t *conflict);
/* narrows the box to what the jerk limit allows after the last `change`; returns 0 where there is no room for it */
int32_t dbk_jerk_box(const dbk_model *model, const dbk_real u_prev[DBK_MAX_DOF], const dbk_real change[DBK_MAX_DOF],
                     dbk_real lower[DBK_MAX_DOF], dbk_real upper[DBK_MAX_DOF]);
void dbk_brake(const dbk_model *model, const dbk_real u_prev[DBK_MAX_DOF], dbk_real u[DBK_MAX_DOF]);
void dbk_set_motion(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx);
void dbk_build_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, dbk_real age, dbk_real extra,
                    int32_t known_only);
void dbk_finish_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx);
/* 0 solved, 1 infeasible, 2 iteration cap */
int32_t dbk_qp(const dbk_rows *rows, int32_t n, const dbk_real scale[DBK_MAX_DOF][DBK_MAX_DOF],
               const dbk_real lower[DBK_MAX_DOF], const dbk_real upper[DBK_MAX_DOF], const dbk_real u_nom[DBK_MAX_DOF],
               int32_t with_slack, dbk_real shift, const int32_t *warm, int32_t n_warm, dbk_solution *solution);
int32_t dbk_check(const dbk_rows *rows, int32_t n, const dbk_real lower[DBK_MAX_DOF], const dbk_real upper[DBK_MAX_DOF],
                  const dbk_real u[DBK_MAX_DOF], dbk_real tolerance);
int32_t dbk_relax(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_real brake[DBK_MAX_DOF],
                  dbk_real u[DBK_MAX_DOF]); /* bit r: rows of rank r were given up in part */
int32_t dbk_certify(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in,
                    const dbk_real u[DBK_MAX_DOF]);

#ifdef __cplusplus
}
#endif
#endif
