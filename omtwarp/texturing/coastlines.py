"""Coastlines of the world, simplified to 1:110 million, for the built-in globe.

Made from Natural Earth (naturalearthdata.com), which is in the public domain: the outlines of the countries with every
border between two countries dropped, rounded to a hundredth of a degree. Kept as text, so that the package needs no
data file.
"""

import base64
import zlib

import numpy as np
from numpy.typing import NDArray


def coastline_segments() -> NDArray[np.float64]:
    """Return the two ends of every straight piece of coast as (longitude, latitude) in degrees, shape [S, 2, 2].

    The pieces form closed rings in the plane of longitude and latitude, with land on one side: a point is on land when
    a path from the outside crosses them an odd number of times. The rings of Antarctica and of the far east of Asia run
    along the map's edge where longitude wraps; those pieces close the rings and are no coast.
    """
    raw = np.frombuffer(zlib.decompress(base64.b85decode("".join(_DATA.split()))), dtype=np.uint8)
    low, high = raw.reshape(2, -1).astype(np.uint16)
    numbers = (low | (high << 8)).astype(np.uint16).view(np.int16)
    ring_count = int(numbers[0])
    lengths = numbers[1 : ring_count + 1].astype(np.int64)
    points = np.cumsum(numbers[ring_count + 1 :].reshape(2, -1), axis=1, dtype=np.int16).T  # differences, modulo 2^16
    following = np.arange(1, len(points) + 1)
    ends = np.cumsum(lengths)
    following[ends - 1] = ends - lengths
    return np.stack([points, points[following]], axis=1) / 100.0


_DATA = r"""
c-qCfcU)S@7dL!CR8&O7E-D~4?7c@#qKPqTj4{ph#F$<-Wq&D~Y|5thy6L?qrW$*Ry;l?!L<B*_ihzy!Bv!EO?)%64Jo6FmaA)Ss%$ak(r;Nw6
o>@^(2F~(xvbVLdw#J*_aK;#nAxd9QS4T%%OG`^rQ$s@?fk3FK!QpUKRoJhhGE|hMiqfwFomdpdio%2<KU5$;i=nlHZodJnm#5rZ43Rg(4&vO5
QDBqVzF@~y3mhX_%vAk02F*qXd9T@QwRXGjy0@<!S8v1n@0cT6tXL|+anm%M_00BLMx3&ZytK{Uo`nt!IBRT**`RxR?FQQr%Vl#>I$@!XhJ*TA
a5<bKxL=oSmh~ZJ^QW7v<i|I1;_Wkb-Lp(Tu<zB!tNWJxuGW&5Uw`cKyTC>HH$|_$q&|Bm4|0g^xN)FB`#N%M4=0NMocvX;jLs+~V_{3X&Q-@W
g0qTG&nd|->e6;3xjTYh82&Iz`$+DpD;ew-7xY8n-R+F(XSpxmYgLMW(3-#y?a!a&dDzvCyB6p&BIhkp?kspq4CK`m5<!~Ub+j7#kLtLuFH&fw
pDJ@}UV829m4AAyKda6>w>>uT_|pth8JY3Crnp$GpU?`mP}CB42<2-o9X`Ev(KBa_JMo+Pj=!O;W*IGA=(Ox?ghm9?pCzmjsT(Xa2@}y_uC4S0
6nLW~+Wj{>{|85-plfx`x63)K4hz$Oku&;_9^J8N&)@UIR^>j{F1L?l&hFhG@ffkrH-7Hg7k5Z`XYwx6KE$Sa9{#<)aV0c2p8W<{|Ke_3toyMY
n_j9P3Q@eaa#q}PMTO&`s@Z-$i&I#uR(Zxa#OZpR02bWSt5`Mv(I0bDZtmIhx3l?$t+Vfm&tMBhiL-)~w4VB4Si7pd_gL&iEy=aJ-WqoF8_UtT
Zd>J>vc%VYAA4#)?c19P#VUq3CK#;g_;7%ZT472HYrQu3{g0cGPS#Im>ONDbdh*mZ=jg+=Pv2$Edy(+hnZ*h>^A_<ApZ=1X_VJHT*1qMKi-6?V
(MWGwSaSgD^`>3q-vopwhZ@hy?cqMJwp>WrM&C`Y&bMDIfB)Nu*swF%;E!U3aBQ?<)L&)sDaRi=tn=G>P3~(yVGH%Zq4dKU8Hd=UYC5F2i<DL+
>NWRRq6Z?q`uvKgQ5BS2&TA4jGYxe5^#^k+_Ql<FZC_CI_DbfX5|?nf1-qBeMC_@2RI=TChQByN*Q=+wApX<y-}hh1YRKF7H>IFi=TODr4{af<
R?M*F#9aDxvfki(Oijt_cWQ423aN@S@kn=XXB{s~g<fSvoP{{?>3Lorr(UJ4w!5f|-Kk>OZ$yRGG<H>`U(U}oZvP6)O>7c$)Vxq?B=#`sI4P&(
i*{fA{s1U_RnerWPz@9lj9xa>KCL8C3R}Bg*3f~@U5Q8Rn=ZsPeGOc_*Z;<q>hf<7PThZ!8ejN>oUPT5HFr?=SLjnUR8<>985n`vG>~!&!e{u;
_cc`Q<HBv+g1l@{CIFdDBv*E@VSSaEeXPtnpu8ZpGND8KVD0NFdQQfNmNsTjDJ`j4j@{9u)e94H=>x?@jATL@Pd>MzkgC9Fs>>=VML<-AjCKZ#
N=WF#`^-1RF7JTsLt@(Cre<!Q2CnDa+|UlXqC6{%rj5gz9m^a{JTSH{c4pvyP#dE>^WFRN54JtO&T30+C2<-%YAY4|<QNKk9NrWmgh7z>x*spE
Tp=aZ^xJEI)kSRG9^%I{RZ9B(ExhKG&T2;fmBiRPCETpC8`;FW?=uP2)G8qd)QAzKmn6j1wY5;i+`8i8wvYUNxUm98*8`&>pfg+L(X@_IB@XlB
y|gSjZC%YSW3^gBdkg3eiS)UUniTuy<EIS;uU-+7ew<Hw*x7vd<-1g7LUA{@iqzcF+tXB3-3HJH*{Vc^i;dwN!lzS-PyXlr<*07-`qY*8{+?(3
mVY;z@FV2Zo$bjFw=6w$^Y#n>`Pu<*Ppcj_J9xM4-1;;7V&RLo?YQT6C~RTW?l1SR^OoP2_${=#bpiVOUmMT9P6AFHps(9JPvP>-(+Y8OxHI<M
r9Wx9_}iDki>GeZ39j4PUQCJ#JhJuWj&Ah4TOqE+iBEoWA4oa<dv(K{_nQ{2I*k4*!mbRwwq|zdiJi5lA|KB*54C{CC#*cN)N<>c565?3ig;Ri
Yxz?Q_QcC5#hHKM9$bqR#;m=Dymj|>5nF=A_Zju4md91)#@sO4_d||m)D}P3M%B^-HRkuDOL(1HX#o&JWq8J&^wJW}_5AW4B-R>aCla>M%h;r%
iXJV-*Sh;%<r!CA$JQXlTAgHa{P(x<nIB$0EMQ6GHR`$t`qj~zvvke3;+F-__x00-s{3zUHbYlf)QaqBX=w*EB;87V3cSv)4lLAAMcY7G&CV7B
!|3X3+91$|Ci(*cWmd09UXI<b*e<W8Z)RsAwopbnSj{kY6S`Yt&79_2f{-4*&;_C94mkZzQ4Us8WooTW6a2x&nar69S-#C9#2xg<f%nE?!3byb
Sw3>6uI2|+7H%^R+KMpNb9V)QM}L6?A9>}#-j{Xj=CP2)CdTTuC3`dCS{RCqURu}v?oX{Z*C$;)|DL1X$x6ERCWVkzbtS&wMM~D-pIjfolkINT
wK|a5_ny?j{auY-eC}y|_O)sKTFUwKmo=E##Mk97*~BZCPtpuZxmH`YtTEo@oJz|;8{0MwSo#E5vW$418W{9o`~3mW;BPgE_m7^|(7q;O%F$si
ZKQ0iZXD8V(9NG~D%5ebG$U)YX|ZdmZF<dJrBxlZZGH9(PDMAD+ELS7E#eh+sE8PK6h2e2gVo3ZsWNmZ6>Y>)6?MgKdT(w$v7o6Wv$F6?@u&RH
B}w0(eZTUdCI24rR%t7?PY0m(H@vxD{;o@{B&Ve?w?bG*0VOo#vDKB0gVfbjk(x%@KE{Ry@(vazVqzCFJ)uOdr#ywzl9>a=n?k<jkja%b-9IXN
^Xs3t@E(7FRDI<XX^R@oVX&^oCfGF>J$3`vCo!l1eyr=PsNfCb&%!6`E;u|1-|uz)nr6YpH`h2eTbajFcF%iu^Fd1#?LzYNdod9`JJxUe!{LH<
kh;?)YGFE)^dM^hnSS&`GVslOp~*u3h4X?t^MkT()4uH8L8Jf*%VJ?$RbkhT>X@yu``dta0`s;9s;&Kd>IW{;)U<PX>_%?OwXZM3D1Yv74E9O?
^J}BSiWiT=AD=q1=Wk)X(Q&W4d#{{1v;9!0|E*K!PoBAT;o7Zp(Fczl*zSj$x%q!*_g?z*?=$CIev}=}Z=(dCJh4C8>dc9Ahoes|S-AIT_{oC@
Ld~PjMF*VP9DVT8pX<GJd9-?3vp~ttLameM;N}+)X71*@)^|?$JdaQ>(*3HqkI4yT90j}NXN5T#Y!jF8V7#`Wosp^$6wN8fJw(Xfa`?o-&uhZg
Ekobk?Q?C>Zvx?d?LVtxufz@V-Y2bhIQa5o`PV^S;mix7oRo6P{iG_u*U_7)YIEi7!9$Vf&IH`M@yEfP7nZFyylpaT^Uml{hrk04|ARPf*E?|h
$R4Ym(ZB7E-nG<w{^mfB-)y2!T7+-kzjgOEyO}%p@7Wc#b=m6ZU^kD==1Vru4T{D^ZeG8CL3rru$eF9dH6y~KRxVo;ro7Di!0hm~VM|u8U%fsm
T-f{M3w$@Hq#}6VUN>V`UwvoaJy9DSjQrOxcJ-JS6}f)LJSS7Th_!2@SNlc;M{Zxad6rYak(t4>|6IRv`}T1E-9ZbS=Ir!8aAb4n?8wN?t0R}K
jNBf*XJsS`;;U|qkJxiE^5p81yXSVy+_wApndm)!%Y&C4+Uu|<c=z7z|2wdI)8@InA_Ar2NX}70N_<UAAJ{|7F3Dp4=2`E%tBX!KEje`IcC#Z!
Gf0d10qC=Ca5R*Z_P45NsrKQamJ1z%ZBYwmsOh_Jan<*f2hXvzs>fKv+;knm)*x$#dG5Zx?e;coYj5WWah&Tcmk2{2Pct3cW)cNPrznPnI0YIy
tF4`-p{Z)bf$~%}dUQ3wW(JCS5EH1-#1CuVr>&-k>ceiIJDclaZegLPKG$}E0eH}!-^~PfRK=00bW#gfKKJU2%IugdwZb>=^70<1ceR#1!M2vY
c2+YV_>@8VDwk1=JeKq%<mlz6x8HV>-)Fo@NX}_0ElWtfRRnfKh+w@%Y)Gw`z{^vHAKq!sSsHnr*y-fFL#g{>ITF5L&9Qap-vW;}JFd6QTy$N+
w07T||D*N7XSo9#RwnA)I$^wzx_94EkY~x6lV%~`P8nZRJkMj-U%R^>pM2=IcaoA-7KD<$JKP_qE-K;tZj!p;wuRQ^f>);p%~usiynYa~E9=YI
V<4V&FYIEtLSe+okWJwD1uI1#dUDrL&Z{PE?pd}vu;cO7hqSO$8;<g}oW;*<IIeJMGor`xG;Z525cU16lu|10ID@pw#qai;FGWGOtXIcu-lKQM
>8YB*=0$s#FP^{cV?uzt+H2hx+RJBp3Pb2yd(&Fp-T#(XeB?tG>}&p=*Y{hFTlqGZ`^0Q*s%w+PZl61_qwbZ)t^L_I{@5P;*EdHOY;B!NO}r2W
e@W6@wb=1T#rfn#Pd8TVgTDv&3P{^#a}&#Es2o_m@QdLdqWXdd=w}OJE_ANw+u`D5i~iW%RS(9j3Ap@FsSEy9KUHV-viPRYy)=Pt=S4z+XdPtn
Qe@YI_ZOcN9tR+8L3T>4&H)_U!QIr_W04WZ(jA1wq4W^?eO(Qm8vRUuZCNIX@bPW#7Y3j5&LlMK!0nAYn_q2$M*7b%Jjg4tcy(w=McRwRq8pKt
sHQCi8n@tS;xnx#)IvcP%qu8F)9S!n2aClaP8Lq`vlb1eBIELcx_6(WLY|07J(ueeOV5$hV|q%<(<1_4(WTT2zpV&&Ok5VV+ZX-%d+$oWhWQZ}
{pCUn|M&XT?0c6^_*(8QYTdX34|md99C~!`2KCS1A4k67M7kyoR8_xO-4!V*s<VI8qMD$X28Co)8}tz8J8RoG1?w&iU2U<-B*GW#H5fFXmzJ8m
dv<MlLu>vs`caDMqeLR7^yX@psGz)Un`htf@aeYN>MD8xCaD)65Bn`u7=Hf3#?&8WdOuv0RtB3?f_~`CSPBdE)<?RDtR2V|mDH}f9%^l~Agv;+
BFxk^)L<UiMlH<W!>NTH%T(f!O22gzJ*hY40@Z~za^+v1%)GZe#BEJ<glBNAhlx6Fo<oc9+J`@hv8AzZn#iw;WAB{xsgBs>v(&b;D0S9s$}+nR
v^lD1A|XwiaWQ-Dlbb#QyfW6?2d&hNW9IZ|yI3FT$Mk(AH~)B5Dvzdf%X*w#kIW2QJj2>dZH~6iTtk4IR$}_?U31=-(iiDBd8TE%vX`><`kuM|
xcJ#Nos4bAXijVTD7*&_2IjtQxM0Lw{z4^1WrYTE1%`2+VU$6uh}#k^%zM$zYzzu{pB0e$sI+j~2F)MYNzC~db_DD*R1kZtbkVWG8o;`k=dT`d
xNtSLALvyWn9Wklez;Op`#knA>;C0Jt#dY=;g|k$#;go9b3Ad8@U(>bt}G}1?~`{6{SSp%s{YVUG`)TJ()Cw&o?ncsnb&>%>>9nVAAei9$=H1P
7GzcoWHYziJ56a-t+hT*jE~x$wN4zH)}_MJg+xOm-PGX99tQ5c-kRcuVs=4E(MLqUoaidnu{SRk9Q=K5nEfr#f}m?_)rm`dZM<hX-TM2m6%4X*
mA{?Fjisu_fk<c19eb7L1-_2Tf4GOD?0@I}oukiRv3@(+`1S~Ez1demmb%+zvl~a}$>+bRID=oYb;fIX^+5$ib0k7fT-VssA{S>Bu=G**70LQ-
Csh6d28$}ev(~zWdMh^cQj*)VGPy|TmKm#!9i#B2E1F()-F@M(&CqCn$eg*_+uv*`ycPs5zW)1xulmpb?ppaI`F7SFP0!UgNe5qXF5d8{QL@?q
TM~dVBj5Ru{w`oG%HSJVuUtrHdr6Q6uEv%YW-wYOt1_=-``;I#!H~)ox4<jaegC|+bBEX0)29yJqta@FTsG62Y_TVSJ(^fWFJ(b-51vu$VC8O&
33nzHB>YIrR`BszxM3hRmh{GOVe#4Eh;4=Hu?w&+*EWi>w>6Nuc1PJMss*k{QIxw^W~im7;>Hf@tEbW4fZROrL8^H*B}`rKq^J;--;o^QYX!Tt
^rf}g<Wk|=(!1w4-=5D|J2M*|V!mnxcHJ4rWplQA8_mc(_=yd2jw(;zcJ|ig7<qf<2c_FLuQy$VS?bJoQBR`fd&Bof2iL2$$Cl)4xP=CZUAeo#
JV<S3ON$vRGS(TcV&q`QVN_SWKCsw3jDC>tzS+&un^Rd!5|V8KY#n-tZ_B+Mc6e%6vEF^OFm^+k_~>0sUZJmK$RDKe?kVH+2dG`WMJrrpTfTiz
^1If7;|KDd?H3&P`X6)qr|LykD;9uw=~v6(;ZDfr@3}f=xWH9q<m1h1ihgV47}4zx^SqsrX+@WTFrV4WIa@A!F0|>+t}c4z?I*7MAyN#|J-pN8
LrmTr*T0}!zg$^yO3gN07xJYr)XY{F*PU4q4X7@@I&fFua&@U`!LDA2IbN@>>aDgB4%E^z7k4sRuKef=L$Rl(Fvc?=tIXmmwr<Ul%djm@Zxm)>
5p`LM9MN9DkBpoRVM<wP8S-j6;NI(jQFn9xBrd#usbNkTXp`%S(=Q6=@G1i`gU*RBBrO3Jba#R;YWb;C30vb9%@;N8SmlD_6E`BYbR;FOb&~{_
)-ICww&<wZZERxE6BlTYV77Cx#;1edgxSrKyP<Uhll}MSB{*g^WTPG_ImuhoAn7!q#U(%;M3*2wjqCmdu4ib>advTBy}`lJ-pbMr<!n6158>%L
!!#OXuHuhcbYzLMzb$_A44_)EP2!5gqt%sq%t0&#3tow7XIW*-+tNaDc@IUYyXtiZu}t4K*uhS<g8+2%s9<Ij8)KlvEycD9^soxH!Fr(ZIdUO*
8?ynO++G(5k>@Jj;2vtX781;zX#h^DQ|ouJ3^0KiEjIH+L|9m8vj-Xlq@w;-h5GJXO*<nEEKEhuj9U=b(x!Bln3z}B*dm}6+G)xuH|Mbd=eF#M
w#ue_{gS@d605M;wjKtGI#_#uGy;mzG&M1r2emX-t2Q<UE2-6&HI<acd<NP&>gmOu^>&CKq+<U20V7u}PbZj_hJ}L7ERPK^ET?iHAJv$Zo7P6n
|CC2a@AxJG*OQ^f9*AamZ>W!w*-TRlZ%Y&7xz>SQK(~U>J8z4V**xv$J=LM%nwqE^mLe^MHU~3z_h^)nf`LH^mC-{|Nhl+=QZ!I?jfS?y-K`R9
OvHR&<2Z1z7Z2xY0B6g&*$vdUyJ9y)dirkHvb1kX&iwptZ&Lmh*0N{HUj%D@yFB9}%V}GSU&Q7M8S{@?^A`y<<C-&YS*=$pQj3|v-1y47^k#c2
vrOHf^?XWzm$y%2J}<vP%g=s^Agj+<4xc^C6H9Nr?BcAgWFLx&T%p;V|EV$Qe_5$}dQ9{k>^){d-J`;1&jlAe=?t`x&s(%jQ>f}Z3+$+Bpw#9f
wz9%gTiIp0k}`5Jy@1YX(fFZ<U{~~nbb*R~5Wm!JA)sgmoK;roIo~wc#CV3LT!+eQjGqldp}cC3qzYOT!>nOyf9EA-RR(-Dt%j#Pu5H^XjHxcZ
+<NbM!1aa;UUoW1Hicaph`D~aVR>eAUm&6sNuQy~&1`evUw{AL+}d5q7cS-GNbKXO3JnbjZQXP>v#OU}bw2%4L1#_B>-;T<B^sRr8cGOj7}6D?
f@-Q@+M3UHsZUN9RHm>AO>^r+#f-wzq=H8;zQr*MX`jCI-#Bva`G;NtwzRb8Hh-Quru+TV<l9FxKhF(IOOJW(=kEb`-fSxl1+MRWogjMoHjh`_
pOuzEpyV)LH}HRk6|)z)&a*Uk@UY8q_gOnX*lUOLfuoB`6O?rSShdeYb)mD9y%&U7pxLFOL<V)l=A@p_NUv<E7sMWodAdXpOKnPFth%_-ZtW4@
bD75uuFi%XG%;VS7Z}nh<{0Uy9#-!v$A%cLKF!9~$rIXQ-?1pfng%L^+A_~YnU<SFf-n&xk-wjhaeqzcmy~*LS1y&?md$8Pk#8+c<$_4%?LbQ{
Ly5{~Ry7bS5(NsxP65Appasm8_jEH1!pqxgSX-jaO(Mem)z{4N+GVcgq3x^_w9p@L!&$&<V~e{nHdp%pz8_VXcfBk9RmY>QyJuU;7hjY=&C6||
(}*la7qLd74?`<x$br?AjR9tEQT@%U$97&l@aaM9nIcv#aWJtqm3k_#zB!v#p82qi@bFDkSweCqsq9u)A}is04qg6HMR!eoLm`<sSR5ZiDB+Zp
B;3ueB=MQ>PED>tEt@1Z0b6rWUbB%Qs}`RKp0{q^z5lu47aj0fAL6@gg;gYemUWPaiMO|w#oF0^8tD03H!j+Q#moy*+r40xx{VsDUcL?N8#qe>
@Y-`4nhYeGk}d`r4A=#`%~Z5-H3{;vP}Q)}Mp!Bss%dG3ScfWGIsl~*A2UZwj5EZ>!476U=-N)u;Iq1w8~eEkI;XX~-xAHU(yP(2>wD!Ni!kC7
$=!-2rR^~FY$r=&dF9qZC;=hzK{h-M6K(Xd*g20~b)~H1?t&lRQv;Xm9PBAAD=aEY>M<&PU!5{YOy_;P`sHHx^H_~)QU!y^?|=K?>Ql_7M=o}A
0%k9szh%V(9cG_CHMefy!wGhd`%b%8$IoWu=e9Jy=aR0HDD@xNTA;y%s>3hTPcBj}OTGEM6#iR$eR_6ng5u(E5sz9<q35&}7K=<-3^u4+AZXI)
qysR9FyWiNyk21!iS!xbZ?>rV2cq%mAmu?EJ$H~yO)t+$On#SGeKEBziwm>XSrTGC%Pm5UAaAS3RpGOlwH;iwPB|B@&LAtUx}1<)-tZ>jP+4Kw
x9@pnOrn7@5^3QTVW_Vog0`3EWOY@4)fe{w%&MOH{*q>4Lzfy?s16>G?+2^E_<XPuN8HKkVfM9=8)~bX34PVg%}jP-4Y9sm0Bu#&(=_7uiMr_w
(Hv#$Vq37*fTNB*pGj@y5sGs^D+c0%@pkAWaX|y1OyHsQ6u|U~fwIqF7CF6GTt?|YLYcj-A8H^43)#srboPT;^;tOu=psnW)g~eBSaxLk{wr_A
@&3_ib%&1Lsm=ySgr?6A<MQv97leJTc$$|{pxJ9Baw~q9TwQjouw6OldkKYO+WdfyDW+vSC<IEr$G5-EyHHngCs!WSQvY0p4e<2!n)QBdh~e^A
lrsI3YF85d*YAcreRAt|_#cNd${U|w^2A5&@L6Q=S3;g`&`b-PHFNxetShVyR;c;<;k7K#P)8F*UuRv<6{rXoLsyg{)?kp*B5E(>_6WSY6)Y50
fHs7-mb$jCrm7*bsTHNHiAJkwpz&CYjarW)2Fd~{Ybt1~gEjHnG5Uj~K9q(n+}0kYfVTDUwO2OOH@2~Gj0*L^>-y;0&w;wwW9EmLSqKbj%D>kn
vj!T#=`Hmo&#NknM3sbYGBCr#UVok|+J>vI>j~wX*~~TYnH3i4<N-63M=2xRqAuuQBf?!5EeTn@BJ%VSTg`@N`r+ZgdTadh8CGHQoXjvw7p_(W
8*bLX4cJ<?Cl7Wsw0mwa(kn<!EK4NPs){R!ii`$ole!(+6^8fL#07iN)yYovj<tZdiAkrOuDg|oyR#zOegJKQG?%osY4_?{Y*Uwb(&R7_Nex~B
*~+6f(^#kunxTOmM8`tQ25*K(;V^tegOMo~Z(yhZS2jiC_Vm$|RjZY?QCMYDGaRx(QxB}HtEJ5!fOmo6eSHwI7-EQMS2t;-Pz}jEraV%}>9)e+
pk}5)T)qOEPT|8fRanqqLYH!#kk@XCt5a^HDr@P(Rp8oaE4;adInLbN3~z2_ZewJMHnKwLE1)%1^wF?pYEv7ckJa2%N20b4HqffcL>jBHj$GG3
enGCQEvlh%C{$8UTYHTVG62+dF(@?U=9)SxiOgow8haQ`4HaaZ5n3Mw=CG^`!P;7Iq#n-1RLBO*g0yvX4Gk^S;ZTUGrmha!*w9=TkJi+|nA@QQ
4MH>XJ~Ce&#;-9}hr@LcS|-i#3W|og0iSFNgNS*2Djf*{z;G1<b>*KS37gUir8MhWA+c}`Z5?eM&OoeVg3?rj^7|RpR0fa9<ZIyDdAvd3PBWo}
R0pmj*EII4o138xO&pXUFoe0OslJA>I-*Y*#z)O&R&)%&2E@wzHaGzP>6N19bC~tnVn79sGJ<GzHqs!?Eqzcl2FmF}0DXN(H3*;#b-*(TL~6G@
SOEYF2WVtEtGS!qBgQgltUg{{D}@c_g9kaSo%A{ifkN!5Z?7ZKYRCjq9ht(ZX15FTD##>i4Y`3vYb<LYXwsv#cJr!NHPtySz!-VxIeG@h24JmB
p<FW+Z6%SBwTqL5Tf{p}JBPMl2Mcuro}QX&WsaoZElgj}!-S{dgoU@%v?$XI`!&i6YeluCrHq0`N)FIMYcO`Tb_=sN^a$3(y0{sdmSu8@rFr#V
%!qY_cV*o7#VN(*)vXyfwW|=fGfAI5=ViWsUHLjM;bqy^vUjE5lN%d^HFecC>du`BD1@S+Pp~5%W<Niv%gxgv=zYUyyvsaOof&fW{q<CZ5>|1I
xF6XoD3WiY$pL;Eo~k+~0p1%uJZ2hNELcD?x3@Pnu?SGH(MN!2Zlpn~tChFFRGIswPT1F_(qL4dYiizEoyh7I#HU|N7to5{_rDvct?vO+2$sy2
tWTZh9x25F!P_ql64LD?VGAoWDed#un8*BuAh&f#W=5_I!tFP;46Wz%VEtXdOkW&FceQE2R&z^Fs9+G|i&oHQEXV8r$XJNKn`UTHQc<Pzqps$8
MS9zd!K8~;Yq@#3mCT0;24QcrDHfg%22Ku5Y~vs>%*1h>jj_G4zK?=2ovUN0hO-6Ab+I+%)!AET0F?U9<h+uSoUEeW)b!hORo$J$ra^rbH9xnd
)=kuSiaI1*lObAYup=TuX=Qo8iM4}?7zKD~T-209m<kv_JwHgVI-ftlWiqQfSfDJ%$L@|^URN1~QAcM%TC-6-FnN2OK*ef54Rc+bxs$Nh1jaYE
FueXW^?XsHkU8*`!YYkxFYQL@%-w7pAiuZ;<L%KB@27{y8As}2`+^WX>wE-yRqZ+5mjjX5U|)ORmF~U}EhNap$I*%x;B8Y~op!dOyvd6mSIzox
;rH45FSZi(Ok9>P(Au<cK<Nft^63@7_dNSbZRd}s;$ncQS)oGG+@cL2EYPmA`aFHW>L?pj#X8%Svnd*jHMAD^nYsmpf=a3x^g2OV!^>xt&v_}Y
k{@ou5oRc0>K*v7(*}!;=UaGpR-j9qsE;h8)z~$U6U)l021sNCir>)FZ-?q#prS57>I{HQEhO-nVYe-V=v+u(+rv%`0Vnpgjd7(~4(ZQ^OKDBG
@HzuCuXXebzi|v#t^?YQOtm$XRR$#uWEEB>0o1_|)Udb$Xuq4jqM?TnrKP5+CtoaX?LBJb>+EmT@uecl{LpSc<o-|h?|v>#s^DKTpWjw4iCaQ6
k2KtY;SOk9nIQ}WY;~Ynt{&VZB-d&Q<+}#;dQuPu>U_n{1JL~D*MIvnV;cv|cyDsR^y<!{<XU~Ta5oDRT*%DXNc^%^VdtY1;w^E?hssYBaZ-MN
#>r^$qVO3D=U-g3B-D3_`_3F3YQ|#^V<9u+jd44Lp+}2XFUou))Ch;Yh1lux<%+2fS4bH8%{2)z)K6b}Vflrvl@8AJUL0+_zD~V|H8N-e(#*v<
NZ-w_y2gS?tc<HI7n9TO6BuBuq7t6p2vA9Ft-^k7=pdQc+y?6rt76<7tYO>;LsJ6EMlPhHgq)WDBDyrL!gHRTT@56Em$vH?*fJXzKMhmWT3T88
(??HYKK85H=<ArngifYmb_g<=P(>irkvW}Ua}LMo+~wGZ8Lfdm&#U?#waeiQtr1+DX=_D!dn&~y0MD!Zp50O^z}3>^phjwLuA9~fY6t84@Z~=`
b4V5<DAG)sYiXsu-k>38V691SIRzmst6*1)u+}{OSz9}J>XS$J7hreYOY;5}v2J_tDH58aXfIc!h{Jh-+4)%mjMi4b@Vzx!QAfV8y)&(m{(TUJ
H$h2^SL0E}R;D;SpxsuTRb4`BY3)$h>lnInph~T|fmRNsHtO0G6?^5(R7-Jdave-h`IgcJ$5=aP7~L?TfN*k@xZ3#67~u>PgT+lM>Ke-8?tU(X
-_B;k4Nh6kn>7Q`E@&b)CnZ&tTf=SpDR7O!^OVo1WO=zIv+z1?J$;l4Vgbh%hciIxg(#d4z0=Tcd6oIl|GGpQ!<%W}uG&;y{i;sMY(Emj)Kzcm
;SR97b<t;yXISXy$f<IfRgCX#JTd8-J~fjySANET=^|Z5TPv}#nCWGXwFHZd`Kp!0aeWBSflcb%0S+t=DunPgn4&&BuBL<l=VKxDVJ3zBHE)%(
ig><$l7<FGW@RhN#$|4XX{T~Cx3^tOgMVUkbf_I9GbQ15j)Os~Q46Jzr;Y;u1p(=bjfkBCHL5dE20jX@YoAgx=&S6!d6w-BSr}H%X)`vhp1{T7
6lyVC=;hCVtu2}wG*hDXjUuS-iQtmUYg8~0Bi%r>6{D+@L^0~U;%JEywZ8874*AnWvA2LJ2j(bz(pD7pw=%`uh<N8d6{Rn<5;Nr>s|NYOZWw(4
@zGzW^zkd6f%)9e%5+vn1EbH(Pu07{f<U3;2s;Gm#6J|M`UiJDD@eR^hrwFVX=5NJRppkWeLO(8W@vQ>w+}u@<%8vPvY`EJ-k=sV*hFoRR#B(l
Z`{R3QktO&LO!LwUB@iL9nPrcGzt3EBm*5SfXD}3#s$~#Enng_Y1~f2VEmjJb2fY|NNG3Kq(e>f8DG{1)3eroj7XsYHPv)GCpR}p(>J`*U}}Jd
peRnRwO6^dva!R;1ZB)aG!=7HvjQMM6Q}j24T{oO2USxv5_J?Q9rYE)<O)2+N-e}LG5V!}xvJ=U?{0mxCYe>U#X^b11XS)=u-ltODvPw_(Pgde
mg@Z^wuXzMvWV4}sl}>;C|O~Yd+1G3a3euSXRf5PSEQ(CE9oo%d#Ml-Rh>;u&E9>}bUX<g%&U#jq|uq;2PW92iexox53^3mRGml_XkP|Cmv=46
p?^~48+?aD+R{{@qGt91Z0RTW=fe7T4#o0RDso4Qhyu!VkT3rX6ZY;$<#K0PCJO+0IWX}5vJC$GNPhlFe*F#CrHf?RfzpHiy}xAa`D@I0nJ{4V
?O3nTm&4PI3>j${`vr`SnM8kVko2h0Ii-k85u8u}sc+f0BcsQ6Fun@e4UJTQkwKCv`7+jRoGarKO<EM_SNqTx0Q%Jz1p3uUEVZ$b!<2wVrT~ra
8uaVO=-CauA3I0MFnfkyjjS3N?go-tvCM3vP2+q3<c1dnNY6OVGV#zJ#N!7ven?VW6A!ONBK}!qrDMX`NOKO5Od&$jvLt;bQ*m}&PR7qdA}u2_
2RC^k(((sLHB2E+quib}`;>Ahtt=ARud!`SQlp8pPbI~&`Xaq!Deg?1cdALpIWzTSqcR1^s@e#Z3F<oC{->lXt$h+1<N*Geq0_M>XM7v~5e>&B
UAosOC`qPZ-{e(InrQS4q_`}Zyp~BMBr*+v6i1{5RRYK$sT7n=BsWRlraTJ(n8Yrr6#^4xorZs7cqb$3)3APwGn388KUuAbJ*H6-U^?lO+JUT<
nZT-Xj2IIE$uzJbkuoI`DLt8h2f&mo1Z2(@0DylLabOCH)1Ar`P&+kdj!WzGJe3C6$?cOS9iuEOAHND;YKfp>BLw>O0mNd7SlaFaQ`7&i?vX??
y|hl#adP)b?#R@w6FB@Y(@lF||2MqGaj^aWd7gja_XPVS%U#g0XfT0sY?A!9X~uPT3bc_mb+S<M57rr&tZtJaRmQEI-VKnU7C$8QLw+0xG-7{#
Rph`Dv1r5(`_<#8T8u#JD6mKym|uz`mP`xvQZhNNmf|5F?&rvX5ifKyE2Jg*=eKxxV`9lf+bkZcEt&3Urt(rI0`5@#trRGLM*P&VImUr|c(1=0
GqR;$9e=%YkurhO5z7Q`P+Ho=GXDDn8$AUEc8mv46G2TPWd%k?T2G_;z*G|QO2*BfL|rDFS~&%Dja#?zFyL49^OUjQ6!N@i!okV93B!axOBq5L
V&i4)B&d-xs>4g7O;X;8T9P$>l;aVRRKOS@qnN-1=SU(!PUFN3l{=FUT09ccES})PjjJkSM3z89N;)Ki!(vxDg+ur2n>eIb63_%?w3r$O1Ezfa
W>^bG-w(;XIBJX|QYIEW)rmZrz~EmG#1u%(nT*Z4;|vy$Xdi4eWF6gN+63w<ziOaS#)&1HC+z2z>=c`2r+hjN7e9-;jC32ya#tFFl%-o9NS(Iy
dsV5y^QDd!F4gCc@v86mN|cB9^Xs_f$JvV;U#Q$TiHl=371`z?q6(v7v;-`hH5h7^pM+e}v&fBw_j;hwC|q}J#QV{T{^(pN>4nHH^QKG;J&uO3
ktcNIJ#^&v=mtj5)oEk^QpOjPf}oKHcziqv^mDz6BmERd-tQZJqK6;yQpBWw4KW)tEbcZk<3}C`hQ5dAf(_LnQhu!bP!%%t4IZM11;&q0er&GM
QF5c^1Q_W*B(g&y_G^qpVma3GOQIx)etv%PNpke(2QotOzd1%yLAhiS%*%R3fV6Wll@lWqasg9@RKUd4mn>9CCYbtvi7I3faw?lXrN=obl9*^q
WGuF9qhxZ>Hx6ksx+LwsO&yj<O)i-@@g(04kWK<jaESh4ib=*tYGva)n`ngrU_zt{NMz#g(IlxvESuV#l$e!FW%{I(Y7?0unJzUm(TScE-%0)<
?>e=k4@{RSn$D@8#7;mmZK7&wBGP%>De~Ad?$flnN*Q-xath!-hF$-j&YC{D{I5B%=@W4O5=#9?@RD-4fPY4bpG9+W+7Xz@OlcsLNu7@$xHQU5
j=26U2Q+2;J>7xGD!L4+O-eS7Ws9W4ze%3^beR%BCei&5$=8W#M_KxSL?-9|&)K7ik@gg+Vn7O6Cs>I|zo$*@P9u#IlkBo`@Q*1;$$yty$-ifN
q*A8SL(QZcpZ}ONnJ(=&MY7@FK;s{;@TSP>O}^`pNayYW*;MAQN)~v`&;T;Q+GMSlS(jvri!kY%#c|^$%{YlP2+7{2{8teDuSf_?lM9~A*?*gS
d=C=I1TRij@25#PNv4Q&Cq~E9W(3E3j$i2k6Vw%uxfYugE&)^OB=G;`a^+WFk?zD@O%!E`%<GA_PgA%mQ>fJRfDZh#*_`4?W$%~(8R(wOY>P=c
ETd?WY2o!>FTth|rwM>I(nln9h*Kh>tU67>yy0ilG!6$a1<=dpvqnz~BmG-4{WZoENvolH&$O3)fUFvgn?B~$NIuonLyhPud^w3s2q7(*Z4=$f
Db3@^ScCBl*i>3Oe%tf&(<Jjx0+Vm+q&cl5i(|l)rbsdzwo2o!WU6}zJ|O)M3V@U~9z_aCJ21(CohXiK|0=MENsE?tBqab>Hi(spSAKo9PU(A%
kg%7z<dm^Kj0w5u@noMKFiqH%4@_|p`t#!gnkfB4?<-_<WNc#Ogz##(J4VV7jFIjGWdECGXgo_A2uHhOWzlV@L&g+diMy1Ql=8zS{40dKjA{TQ
OqSZT<^-};<BsZ3e-qjN+z`oTJYj(JwWOSkzfmu<WT=!cJ|vN2G|}VXfh2bv{Q;p=vK%cXRs&LFG2=r8<CCe3#~WQ^xCHc#W0cbP^-9&4`Ewd`
FQ8+40*!54ICgxXNiqH~Xbito9CMP!RZM+Mu^Yy?(>1yRlTmc!j<!KY>GzH<SOt)}6Z%<!j}R;#nZRp=s9<Dd#|XDnM%qau@3lvkJTP)lun{_f
k)z>{V1&^K<EbO_2}c%dJeK7f8a4dr8SbPs{9q4v8A&pVhY60*8MazKsSgkP^&kzkdjS)|v|$MWI76)pLqvx6Od0Ajya3ElpT_ZY2p}4&8UJeS
8s!_%{i|gV7;YX~garQc*RN$8|NQ(POhTuZ
"""
