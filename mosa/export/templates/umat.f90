! Law "@LAW@" as a UMAT of Abaqus, written by MoSA. SI units; free form (-free, or .f90). Not for CalculiX: it takes stresses turned
! back by the rotation of DFGRD1 (umat_abaqusnl.f), and these are in the axes of space.
! Directions of fibres are in the axes of DFGRD1: give the section no *ORIENTATION. *USER MATERIAL, CONSTANTS=@COUNT@:
@PROPS@
module mosa_law
  implicit none
  integer, parameter :: first(6) = (/1, 2, 3, 2, 1, 1/), second(6) = (/1, 2, 3, 3, 3, 2/)  ! 11 22 33 23 13 12
contains

! Energy, second Piola-Kirchhoff stress and 2 dS/dC of the part that is written in the entries of C
subroutine of_entries(C11, C22, C33, C23, C13, C12, props, psi, S, CC)
  double precision, intent(in) :: C11, C22, C33, C23, C13, C12, props(*)
  double precision, intent(out) :: psi, S(6), CC(6, 6)
  integer :: i, j
  @ENTRIES@
  do i = 1, 6
    do j = 1, i - 1
      CC(i, j) = CC(j, i)
    end do
  end do
end subroutine

! Of the part in the principal stretches: psi, s_i = (1/l_i) dpsi/dl_i, ds_ij = (1/l_j) ds_i/dl_j
subroutine of_stretches(l1, l2, l3, props, psi, s, ds)
  double precision, intent(in) :: l1, l2, l3, props(*)
  double precision, intent(out) :: psi, s(3), ds(3, 3)
  @PRINCIPAL@
end subroutine

! Eigenvalues (w) and vectors (columns of V) of a symmetric matrix, by Jacobi's rotations
subroutine eigen(matrix, w, V)
  double precision, intent(in) :: matrix(3, 3)
  double precision, intent(out) :: w(3), V(3, 3)
  double precision :: A(3, 3), R(3, 3), t, z, co
  integer :: sweep, p, q
  A = matrix
  V = 0.0d0
  do p = 1, 3
    V(p, p) = 1.0d0
  end do
  do sweep = 1, 30
    if (abs(A(1, 2)) + abs(A(1, 3)) + abs(A(2, 3)) < 1.0d-300) exit
    do p = 1, 2
      do q = p + 1, 3
        if (A(p, q) == 0.0d0) cycle
        z = (A(q, q) - A(p, p))/(2.0d0*A(p, q))
        t = sign(1.0d0, z)/(abs(z) + sqrt(1.0d0 + z*z))
        co = 1.0d0/sqrt(1.0d0 + t*t)
        R = 0.0d0
        R(1, 1) = 1.0d0
        R(2, 2) = 1.0d0
        R(3, 3) = 1.0d0
        R(p, p) = co
        R(q, q) = co
        R(p, q) = t*co
        R(q, p) = -t*co
        A = matmul(transpose(R), matmul(A, R))
        A(p, q) = 0.0d0
        A(q, p) = 0.0d0
        V = matmul(V, R)
      end do
    end do
  end do
  w = (/A(1, 1), A(2, 2), A(3, 3)/)
end subroutine

subroutine add_stretches(C, props, psi, S, CC)
  double precision, intent(in) :: C(3, 3), props(*)
  double precision, intent(inout) :: psi, S(6), CC(6, 6)
  double precision :: w(3), V(3, 3), more, pr(3), ds(3, 3), q, a(6), b(6)
  integer :: i, j, k
  call eigen(C, w, V)
  call of_stretches(sqrt(w(1)), sqrt(w(2)), sqrt(w(3)), props, more, pr, ds)
  psi = psi + more
  do i = 1, 3
    do k = 1, 6
      a(k) = V(first(k), i)*V(second(k), i)
    end do
    S = S + pr(i)*a
    do j = 1, 3
      do k = 1, 6
        b(k) = V(first(k), j)*V(second(k), j)
      end do
      CC = CC + ds(i, j)*spread(a, 2, 6)*spread(b, 1, 6)
    end do
    do j = 1, i - 1
      if (abs(w(i) - w(j)) > 1.0d-5*(w(i) + w(j))) then
        q = (pr(i) - pr(j))/(w(i) - w(j))
      else
        q = 0.25d0*(ds(i, i) - ds(i, j) + ds(j, j) - ds(j, i))
      end if
      do k = 1, 6
        b(k) = V(first(k), i)*V(second(k), j) + V(first(k), j)*V(second(k), i)
      end do
      CC = CC + q*spread(b, 2, 6)*spread(b, 1, 6)
    end do
  end do
end subroutine

! Energy per volume now, Cauchy stress and the tangent of its Jaumann rate (of the Kirchhoff stress over J), in the order
! 11 22 33 23 13 12
subroutine stress_and_tangent(F, props, stored, sigma, tangent)
  double precision, intent(in) :: F(3, 3), props(*)
  double precision, intent(out) :: stored, sigma(6), tangent(6, 6)
  double precision :: C(3, 3), psi, S(6), CC(6, 6), T(6, 6), J, g(3, 3), d(3, 3)
  integer :: a, b, i, k, m, n
  C = matmul(transpose(F), F)
  call of_entries(C(1, 1), C(2, 2), C(3, 3), C(2, 3), C(1, 3), C(1, 2), props, psi, S, CC)
  if (@SPECTRAL@) call add_stretches(C, props, psi, S, CC)
  J = F(1, 1)*(F(2, 2)*F(3, 3) - F(2, 3)*F(3, 2)) - F(1, 2)*(F(2, 1)*F(3, 3) - F(2, 3)*F(3, 1)) &
    + F(1, 3)*(F(2, 1)*F(3, 2) - F(2, 2)*F(3, 1))
  stored = psi/J
  do a = 1, 6
    do b = 1, 6
      T(a, b) = F(first(a), first(b))*F(second(a), second(b))
      if (b > 3) T(a, b) = T(a, b) + F(first(a), second(b))*F(second(a), first(b))
    end do
  end do
  sigma = matmul(T, S)/J
  tangent = matmul(T, matmul(CC, transpose(T)))/J
  do a = 1, 6
    g(first(a), second(a)) = sigma(a)
    g(second(a), first(a)) = sigma(a)
  end do
  d = 0.0d0
  d(1, 1) = 1.0d0
  d(2, 2) = 1.0d0
  d(3, 3) = 1.0d0
  do a = 1, 6
    i = first(a)
    k = second(a)
    do b = 1, 6
      m = first(b)
      n = second(b)
      tangent(a, b) = tangent(a, b) + 0.5d0*(d(i, m)*g(k, n) + d(i, n)*g(k, m) + d(k, m)*g(i, n) + d(k, n)*g(i, m))
    end do
  end do
end subroutine
end module

subroutine umat(stress, statev, ddsdde, sse, spd, scd, rpl, ddsddt, drplde, drpldt, stran, dstran, time, dtime, temp, &
    dtemp, predef, dpred, cmname, ndi, nshr, ntens, nstatv, props, nprops, coords, drot, pnewdt, celent, dfgrd0, dfgrd1, &
    noel, npt, layer, kspt, kstep, kinc)
  use mosa_law
  implicit none
  character*80 cmname
  integer :: ndi, nshr, ntens, nstatv, nprops, noel, npt, layer, kspt, kstep, kinc
  double precision :: stress(ntens), statev(nstatv), ddsdde(ntens, ntens), sse, spd, scd, rpl, ddsddt(ntens), &
    drplde(ntens), drpldt, stran(ntens), dstran(ntens), time(2), dtime, temp, dtemp, predef(1), dpred(1), props(nprops), &
    coords(3), drot(3, 3), pnewdt, celent, dfgrd0(3, 3), dfgrd1(3, 3)
  double precision :: sigma(6), tangent(6, 6)
  integer :: a, b, n
  integer, parameter :: order(6) = (/1, 2, 3, 6, 5, 4/)  ! Abaqus: 11 22 33 12 13 23
  if (ndi /= 3) error stop "MoSA UMAT: three direct stresses are needed (3D, plane strain, axisymmetric), not plane stress"
  call stress_and_tangent(dfgrd1, props, sse, sigma, tangent)
  n = min(ntens, 6)
  do a = 1, n
    stress(a) = sigma(order(a))
    do b = 1, n
      ddsdde(a, b) = tangent(order(a), order(b))
    end do
  end do
end subroutine

! n deformations at once, for a check from another language
subroutine mosa_check(n, gradients, nprops, props, stored, stresses, tangents) bind(C)
  use, intrinsic :: iso_c_binding
  implicit none
  integer(c_int), value :: n, nprops
  real(c_double) :: gradients(3, 3, n), props(nprops), stored(n), stresses(6, n), tangents(6, 6, n)
  double precision :: none, many(6), times(2), point(3), turn(3, 3)
  character*80 cmname
  integer :: i
  cmname = "@LAW@"
  none = 0.0d0
  many = 0.0d0
  times = 0.0d0
  point = 0.0d0
  turn = 0.0d0
  do i = 1, n
    call umat(stresses(:, i), many, tangents(:, :, i), stored(i), none, none, none, many, many, none, many, many, times, none, &
      none, none, times, times, cmname, 3, 3, 6, 1, props, nprops, point, turn, none, none, turn, gradients(:, :, i), &
      1, 1, 1, 1, 1, 1)
  end do
end subroutine
