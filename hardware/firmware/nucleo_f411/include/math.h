#ifndef MATH_H
#define MATH_H

#define NAN (__builtin_nanf(""))

#endif
