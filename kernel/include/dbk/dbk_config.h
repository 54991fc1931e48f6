/* Sizes, number type and named tolerances of the kernel. Every size is a macro, so that memory is static and known. */
#ifndef DBK_CONFIG_H
#define DBK_CONFIG_H

#ifdef DBK_DOUBLE
typedef double dbk_real;
#else
typedef float dbk_real;
#endif

#ifndef DBK_MAX_DOF
#define DBK_MAX_DOF 8 /* controlled joints */
#endif
#ifndef DBK_MAX_SPHERES
#define DBK_MAX_SPHERES 112 /* spheres that cover the body */
#endif
#ifndef DBK_MAX_HELD
#define DBK_MAX_HELD 8 /* spheres that cover a held object */
#endif
#ifndef DBK_MAX_LINKS
#define DBK_MAX_LINKS 20 /* rigid parts of the body */
#endif
#ifndef DBK_MAX_PAIRS
#define DBK_MAX_PAIRS 96 /* link pairs that are kept apart */
#endif
#ifndef DBK_MAX_OBSTACLES
#define DBK_MAX_OBSTACLES 512 /* a multiple of DBK_LANES; a microcontroller takes 48 */
#endif
#ifndef DBK_MAX_ROWS
#define DBK_MAX_ROWS 512 /* rows that may bind in one step; a multiple of DBK_LANES */
#endif

#ifndef DBK_MAX_USER
#define DBK_MAX_USER 16 /* rows that are handed in ready-made */
#endif

#ifndef DBK_MAX_VISITS
#define DBK_MAX_VISITS 1024 /* groups of pairs that one step could bring to h = 0 */
#endif

#ifndef DBK_LANES
#define DBK_LANES 8 /* a power of two; 1 where the processor has no vectors. The answers are the same. */
#endif
#define DBK_PADDED(count) (((count) + DBK_LANES - 1) & ~(DBK_LANES - 1)) /* so many that vectors are full */
#define DBK_OBSTACLE_ROOM (DBK_MAX_OBSTACLES + 2 * DBK_LANES) /* no power of two: arrays share no lines of a cache */
#define DBK_ALL_SPHERES (DBK_MAX_SPHERES + DBK_MAX_HELD)
#define DBK_SPHERE_ROOM (DBK_ALL_SPHERES + DBK_LANES) /* loops over a link's spheres may run on to a full vector */
#define DBK_ALL_LINKS (DBK_MAX_LINKS + 1)
#define DBK_ROW_ROOM (DBK_MAX_ROWS + DBK_LANES)       /* and so may loops over rows */
#define DBK_MAX_SPANS (DBK_ALL_SPHERES + DBK_ALL_LINKS * 2 + DBK_MAX_PAIRS)
#define DBK_QP_DIM (DBK_MAX_DOF + 1) /* joints and one slack */
#define DBK_QP_CAP 80                /* iterations of the active set; reaching it is a fault */

/* Tolerances. Rows are unit rows in joint space, so row tolerances are in rad/s. */
#ifdef DBK_DOUBLE
#define DBK_QP_TOL 1e-11          /* a row violated by less counts as met inside the QP */
#define DBK_QP_SHIFT 1e-10        /* rows are tightened by this before the QP, so that its answer meets them as written */
#define DBK_QP_DEPENDENT 1e-9     /* sine of the angle below which a normal counts as dependent */
#define DBK_CHECK_TOL 1e-8        /* what the independent checker forgives in a row */
#else
#define DBK_QP_TOL 2e-6f
#define DBK_QP_SHIFT 8e-6f
#define DBK_QP_DEPENDENT 1e-4f
#define DBK_CHECK_TOL 1e-4f
#endif
#define DBK_GRANTED (DBK_QP_SHIFT * 4)     /* [rad/s] what a rank is granted beyond its least violation, for rounding */
#define DBK_GIVEN_UP ((dbk_real)1e-4)      /* [m/s] a rank that is violated by less does not count as given up */
#define DBK_ZERO_GRADIENT ((dbk_real)1e-4) /* [m/rad] a row with a smaller normal cannot be acted upon */
#define DBK_CULL_FLOOR ((dbk_real)1e-3)    /* [m] pairs nearer than this are never culled */
#define DBK_TRUST_TRIES 3                  /* trust boxes that are tried before the whole box is taken */
#define DBK_TRUST ((dbk_real)0.02)         /* half the width of the trust box, as a share of v_max */
#define DBK_FAR_OUTSIDE ((dbk_real)0.2)    /* [rad] beyond a joint limit by more: the state is not believed */

#endif
